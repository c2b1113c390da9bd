"""HPS: a body from worn IMUs and a head camera, registered in a scanned scene."""
