"""A body model in the files of other programs: skinned GLB, BVH, body-model `.npz`, meshes."""
