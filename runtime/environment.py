"""The environment that every process computes in, and the exit statuses of programs and nodes.

Imports nothing: numpy's libraries read the environment when they are loaded.
"""

# One thread for BLAS and OpenMP in every process: DESIGN.md measured 100 times the latency with more on busy cores.
# In `evaluate` too, which must compute as the nodes do.
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "OPENCV_FFMPEG_LOGLEVEL": "-8",  # FFmpeg prints every damaged block of a film; a status reports the frame
    "ORT_DISABLE_TELEMETRY": "1",  # onnxruntime's wheels come with it on
    # glibc: what a frame's images leave is for those of the next, in place of going back to the kernel, which hands out
    # each page again with a fault (docs/deployment.md)
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),  # the most that it takes
    "MALLOC_TRIM_THRESHOLD_": str(1 << 32),
    "MALLOC_TOP_PAD_": str(16 << 20),
    "MALLOC_ARENA_MAX": "1",  # of one heap for all threads, whatever thread an image is made in
}
USER_ERROR_STATUS = 2  # of the program and of a node: what the user gave can't be used
INTERRUPTED_STATUS = 130
CLOSED_PIPE_STATUS = 141
# Whose versions a run writes down
LIBRARIES = ("birdslam", "numpy", "opencv-python-headless", "onnxruntime", "gtsam", "eclipse-zenoh")
ONNXRUNTIMES = ("onnxruntime", "onnxruntime-openvino", "onnxruntime-gpu")  # packages of the same library


def library_versions() -> dict[str, str]:
    """Python's, and those of LIBRARIES."""
    import platform
    from importlib.metadata import PackageNotFoundError, version

    out = {"python": platform.python_version()}
    for library in LIBRARIES:
        for package in ONNXRUNTIMES if library == "onnxruntime" else (library,):
            try:
                out[library] = version(package)
                break
            except PackageNotFoundError:
                continue
    return out
