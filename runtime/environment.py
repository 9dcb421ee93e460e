"""The environment variables of every process, and the exit statuses of programs and nodes.

Imports nothing, since numpy's libraries read the environment when they are loaded.
"""

# One thread for BLAS and OpenMP in every process, since more raise the latency on busy cores
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "OPENCV_FFMPEG_LOGLEVEL": "-8",  # FFmpeg logs every damaged block; a status reports the frame
    "OPENCV_IO_MAX_IMAGE_PIXELS": str(1 << 26),  # a damaged head may state 32,000 x 32,000; 8K has half of this
    "ORT_DISABLE_TELEMETRY": "1",
    # glibc keeps the memory of a frame's images for the next frame, which avoids page faults (docs/deployment.md)
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),  # its maximum
    "MALLOC_TRIM_THRESHOLD_": str(1 << 32),
    "MALLOC_TOP_PAD_": str(16 << 20),
    "MALLOC_ARENA_MAX": "1",  # one heap for all threads
}
USER_ERROR_STATUS = 2  # of the program and of a node: invalid input
INTERRUPTED_STATUS = 130
CLOSED_PIPE_STATUS = 141
# Their versions are in the summary of a run
LIBRARIES = ("birdslam", "numpy", "opencv-python-headless", "onnxruntime", "gtsam", "eclipse-zenoh")
ONNXRUNTIMES = ("onnxruntime", "onnxruntime-openvino", "onnxruntime-gpu")  # packages of the same library


def library_versions() -> dict[str, str]:
    """Returns the versions of Python and LIBRARIES."""
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
