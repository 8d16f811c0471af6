"""Where the program begins: what asks it to end is heard from the first moment on."""

import gc
import os
import sys

from rejoint.system.stopping import Interrupted, ignore, install


def main() -> None:
    """Run the command line."""
    install()
    gc.set_threshold(50_000)  # a collection searches all that PyTorch and Numba made
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads make small matrices 2 to 3 times slower
    try:
        from rejoint.cli import main as run  # takes half a second
    except Interrupted as error:
        sys.stderr.write(f"error: {error}; nothing was begun\n")
        sys.exit(error.exit_code)
    try:
        run()
    finally:
        ignore()
        gc.freeze()  # the end of a process that has PyTorch takes a second less


if __name__ == "__main__":
    main()
