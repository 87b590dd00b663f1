"""What the files in the folder of a run are called."""

DENSE_CLOUD = "dense.ply"
DENSE_VIEW, ERROR_MAP = "dense_view.png", "error_map.png"
DENSE_RESULTS = (DENSE_CLOUD, "mesh.ply", "dsm.npz", "dsm.png", "dsm.tif", DENSE_VIEW, ERROR_MAP)
DEPTH_MAPS = "dense"  # the folder of the depth maps
PARTS = f"{DEPTH_MAPS}/parts"  # of what is finished while the stage is not
