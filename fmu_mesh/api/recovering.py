"""`recover`: finishes the result file of a run whose writer was killed."""

from __future__ import annotations

from pathlib import Path

from ..config.call_options import checked
from ..errors import ConfigurationError
from ..files import Kept, is_file, open_alone
from ..results.recording import reading, result_format
from ..text import nearest_file

__all__ = ["recover"]


@checked
def recover(path: str | Path) -> int:
    """Finish the result file of a run that was killed, and return the number of its rows, which are all whole.

    A CSV is cut off after its last whole row. A Parquet file is made of the stream beside it (`<file>.arrows`). An MCAP
    is cut off after its last whole row and gets its index. A file that is complete stays as it is.

    `launch` does this itself if only its master was killed; `recover` is for a computer or a container that went down.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
        >>> result = mesh.run(stop_time=0.1, output="results/short.csv")
        >>> fmu_mesh.recover("results/short.csv")
        51

    Args:
        path: the result file, under the name that the run was given.

    Raises:
        ConfigurationError: there is no such file, a run is still writing it, it is no result file, or it cannot be
            written.
    """
    path = Path(path)
    format_ = result_format(path)
    if format_ is None:
        raise ConfigurationError(f"no installed package writes the format of '{path}'.")
    growing = format_.growing_file(path)
    with reading(path):
        try:
            if not is_file(growing):
                if not is_file(path):
                    raise _missing(path)
                return format_.keep_whole_rows(path, Kept())
            with open_alone(growing, path):
                return format_.keep_whole_rows(path, Kept())
        except OSError as error:
            text = f"the result file '{path}' cannot be recovered: {error.strerror or error}."
            raise ConfigurationError(text) from error


def _missing(path: Path) -> ConfigurationError:
    near = nearest_file(path)
    hint = f"Did you mean '{near}'?" if near is not None else None
    return ConfigurationError(f"the result file '{path}' does not exist.", hint=hint)
