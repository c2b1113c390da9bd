"""Where a camera stands in a known scene: map, retrieval, matching, absolute pose."""
