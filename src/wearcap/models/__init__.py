"""Plain networks: tensors in, tensors out; no Lightning, no losses, no schedules.

What one system alone uses stands in its folder. `layers.py` has what they share; one file each for the networks that
encode images, objects' points and the points around the body, for the pose regressor, and for the motion autoencoder of FID.
`checkpoint.py` brings any of them back, without executing anything from its file; `weights.py` reads the
user's own weights.
"""
