"""Everything about geometry and pose: the TSDF volume, meshing, metrics and locating new frames.

Importing this package loads no ``bpy``. The same Warp kernels serve CPU and CUDA.
"""
