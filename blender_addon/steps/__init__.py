"""The four steps (scan, fuse, locate, compare), each as a job that runs commands and brings their results in."""
