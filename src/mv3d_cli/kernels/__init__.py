"""Hot operations: Warp source (one for CPU and CUDA), a torch twin as reference, and the dispatch between devices."""
