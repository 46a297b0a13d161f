"""The program of a child process that describes a model: `python -Pm fmu_mesh.instances MODULE REQUEST`.

`fmu_mesh.instances.child_question` starts it. ``answer_to`` of the module answers, on standard output. A thread waits
for the end of standard input, which is that of the asking process: a model may not return (ADR 56).
"""

import os
import sys
import threading
from importlib import import_module


def main() -> None:
    """Answer the request."""
    answers = os.dup(1)
    os.dup2(2, 1)  # what a component writes is no answer

    def end_with_parent() -> None:
        while os.read(0, 4096):
            pass
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    _, module, request = sys.argv
    answer = import_module(module).answer_to(request)  # only now may anything else write
    while answer:
        answer = answer[os.write(answers, answer) :]
    os._exit(0)  # the component may have started threads


if __name__ == "__main__":
    main()
