"""The command `fmu-mesh`, and `python -m fmu_mesh`: Ctrl-C has its exit code even while the command is being loaded."""

import sys

from .errors import FmuMeshError, Interrupted


def main() -> int:
    """Load the command, which takes half a second, and run it; returns the exit code."""
    try:
        from .cli.limits import FEWEST_MIB, check_address_space  # noqa: PLC0415 an interrupt must find us here

        check_address_space(FEWEST_MIB)
        from .cli.main import main as command  # noqa: PLC0415 needs memory, and half a second
    except FmuMeshError as error:
        print(f"fmu-mesh: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("fmu-mesh: interrupted", file=sys.stderr)
        return Interrupted.exit_code
    return command()


if __name__ == "__main__":
    if not sys.flags.safe_path:
        # `python -m` looks for modules in the current folder first; the command `fmu-mesh` does not, and both are one.
        del sys.path[0]
    raise SystemExit(main())
