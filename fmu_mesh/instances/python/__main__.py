"""The program of the child process that imports a component to describe it: `python -Pm fmu_mesh.instances.python`.

`fmu_mesh.instances.python.asking` starts it. The request is its argument, and the answer its standard output.
"""

import os
import sys
import threading


def main() -> None:
    """Import the component of the request, and write the answer."""
    answers = os.dup(1)
    os.dup2(2, 1)  # what the component writes is no answer
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from .asking import answer_to  # noqa: PLC0415 only now may anything else write

    answer = answer_to(sys.argv[1])
    while answer:
        answer = answer[os.write(answers, answer) :]
    os._exit(0)  # the component may have started threads


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
