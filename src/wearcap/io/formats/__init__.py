"""Files that programs exchange: motions, meshes, clouds, pictures, tables."""
