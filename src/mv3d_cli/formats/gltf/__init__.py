"""glTF 2.0, .gltf and .glb, as triangles with materials.

trimesh is not enough here: it drops sampler wrapping and texture transforms, does not open Draco, and follows
addresses out of the file's folder.
"""
