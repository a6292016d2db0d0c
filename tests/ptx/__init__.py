"""NVRTC's PTX, executed on the CPU: an oracle for what kernels do on a GPU, where there is none.

PTX is translated to C, compiled by the system's compiler, and run a thread after the other. It shows the arithmetic and
the logic of the code that a GPU would get, and Warp's host code for CUDA with it; it shows nothing of races between
threads, of NVIDIA's driver, or of speed.
"""
