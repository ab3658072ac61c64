"""A renderer's first picture on a GPU, in a process of its own: `held_kernels DEVICE`.

Prints what it is told, `in` when it may draw, and draws until a line comes.
"""

import sys

from pipeline.stages.gpu_kernels import compiled_once

if __name__ == "__main__":
    with compiled_once(sys.argv[1], "5.0.1", lambda told: print(f"told {told}".strip(), flush=True)):
        print("in", flush=True)
        if sys.stdin.readline() == "fail\n":
            raise RuntimeError("the picture could not be drawn")
    print("out", flush=True)
