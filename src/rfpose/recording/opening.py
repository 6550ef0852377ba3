"""Find out what a path holds and open it."""

from __future__ import annotations

from pathlib import Path

from rfpose.errors import RecordingError
from rfpose.recording.base import Recording
from rfpose.recording.native import NativeRecording
from rfpose.scenario import Scenario

__all__ = ["open_recording"]

_SIGMF_SUFFIXES = (".sigmf-meta", ".sigmf-data")


def open_recording(path: str | Path, *, scenario: Scenario | None = None, follow_links: bool = False) -> Recording:
    """Open a recording, whichever of the known formats it has.

    Parameters
    ----------
    path
        An rfpose-iq file; a Digital RF directory, whose channels are the receivers; a directory of SigMF
        recordings, one a receiver, or one ``.sigmf-meta`` file.
    scenario
        The site, in place of the one found in the recording. It is not compared with the recording here; see
        `check_against`.
    follow_links
        Read what the recording names outside its own folder, too: links in the file system, SigMF's ``core:dataset``,
        HDF5's external links, external storage and virtual datasets. A recording from elsewhere could so make any
        file be read.

    Raises
    ------
    RecordingError
        Nothing there, another format, damaged, or a library for the format is not installed. The message
        names the file, the place inside it and the remedy.
    ScenarioError
        The embedded scenario is malformed.

    Examples
    --------
    >>> import rfpose as rf
    >>> with rf.open_recording("night.h5") as recording:  # doctest: +SKIP
    ...     recording.plot()
    """
    path = Path(path)
    try:
        exists = path.exists()
    except (OSError, ValueError) as error:  # too long, or with a zero byte
        raise RecordingError(f"{str(path)!r:.200}: no path of a file ({error!s:.60}); check the path") from error
    if not exists:
        raise RecordingError(f"{path}: no such file or directory; check the path")
    if path.is_dir():
        return _open_directory(path, scenario, follow_links=follow_links)
    if path.suffix in _SIGMF_SUFFIXES:
        from rfpose.recording.sigmf_files import SigmfRecording

        return SigmfRecording(path, scenario=scenario, follow_links=follow_links)
    if path.suffix in (".sigmf", ".sigmf-collection"):
        raise RecordingError(
            f"{path}: a SigMF archive or collection; unpack it (`tar xf`) and give the directory of .sigmf-meta files"
        )
    return NativeRecording(path, scenario=scenario, follow_links=follow_links)


def _open_directory(path: Path, scenario: Scenario | None, *, follow_links: bool) -> Recording:
    if any(path.glob("*/drf_properties.h5")):
        from rfpose.recording.drf import DigitalRfRecording

        return DigitalRfRecording(path, scenario=scenario, follow_links=follow_links)
    if any(path.glob("*.sigmf-meta")):
        from rfpose.recording.sigmf_files import SigmfRecording

        return SigmfRecording(path, scenario=scenario, follow_links=follow_links)
    if (path / "drf_properties.h5").exists():
        raise RecordingError(f"{path}: this is one channel of a Digital RF recording; give `{path.parent}` instead")
    raise RecordingError(
        f"{path}: a directory with neither Digital RF channels (*/drf_properties.h5) nor SigMF recordings "
        "(*.sigmf-meta); check the path"
    )
