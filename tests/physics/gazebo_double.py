"""A program that speaks the protocol of Gazebo's lock-step program, as a test tells it to.

Joints are masses of 1 kg without friction; links stand at (1, 2, 3) and are turned by 90 degrees about z. The first
argument is what goes wrong: `nothing`, `start` (no answer but words on standard error), `refuse`, or in the second step
`die`, `hang` or `nan`.
"""

from __future__ import annotations

import sys

HALF = 0.5**0.5
LINK = [1.0, 2.0, 3.0, HALF, 0.0, 0.0, HALF, 0.5, 0.25, 0.0, 0.0, 0.0, 1.0]


def say(*words: object) -> None:
    """Answer with one line."""
    print(*words, flush=True)  # noqa: T201  the protocol


def loaded() -> tuple[int, int]:
    """Read what comes before `go`: how many joints and links there are."""
    commands = []
    while (line := sys.stdin.readline()) != "go\n":
        if not line:
            say("error standard input ended before go")
            sys.exit()
        command, *words = line.split()
        if command == "world":
            sys.stdin.read(int(words[0]))
        commands.append(command)
    return commands.count("joint"), commands.count("link")


def fail(fault: str) -> None:
    """Do what goes wrong in the second step."""
    if fault == "hang":
        sys.stdin.read()
    if fault == "die":
        sys.exit("the engine is broken")


def main(fault: str) -> None:
    """Answer until the end of standard input."""
    joints, links = loaded()
    if fault == "start":
        sys.exit("no such engine")
    if fault == "refuse":
        say("error the world has no joint arm::elbow")
        return
    state = [0.0] * (3 * joints) + LINK * links
    say("gazebo 11.0 double")
    say(*state)
    step_size, steps = 0.0, 0
    for line in sys.stdin:
        command, count, *numbers = line.split()
        if command == "step_size":
            step_size = float(count)
            continue
        steps += 1
        if steps == 2:
            fail(fault)
        for _ in range(int(count)):
            for joint in range(joints):
                state[3 * joint + 2] = float(numbers[joint])
                state[3 * joint + 1] += step_size * state[3 * joint + 2]
                state[3 * joint] += step_size * state[3 * joint + 1]
        say(*(["nan"] if fault == "nan" and steps == 2 else state[:1]), *state[1:])


main(sys.argv[1])
