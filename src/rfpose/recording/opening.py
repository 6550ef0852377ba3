"""Find out what a path, or several, hold and open it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TypeAlias

from rfpose.errors import InvalidInputError, RecordingError, ScenarioError, UnlikeError
from rfpose.heaps import open_hdf5
from rfpose.kinds import COMPRESSED_SIGMF, SIGMF_ENDINGS, is_hdf5, kind_of
from rfpose.recording.base import Recording
from rfpose.recording.declared import Declared
from rfpose.recording.gnuradio import GnuRadioRecording, is_gnuradio_header
from rfpose.recording.manifest import MANIFEST_FILE, is_manifest, read_manifest
from rfpose.recording.members import members
from rfpose.recording.native import NativeRecording
from rfpose.recording.parts import Part, PartsRecording
from rfpose.recording.raw import RawRecording
from rfpose.recording.wav import WavRecording, is_wav
from rfpose.scenario import Scenario, load_scenario

__all__ = ["RecordingSource", "files_of", "open_recording"]

RecordingSource: TypeAlias = str | Path | Sequence[str | Path]
"""What `open_recording` opens: one path, or several that make one recording."""

_IN_A_SET = ("*.h5", "*.hdf5", "*.wav", "*.WAV", "*.sigmf", "*.hdr", *(f"*{suffix}" for suffix in COMPRESSED_SIGMF))
"""Files in a directory that may be parts of a recording."""


def open_recording(
    path: RecordingSource,
    *,
    scenario: Scenario | None = None,
    declared: Declared | None = None,
    follow_links: bool = False,
) -> Recording:
    """Open a recording, whichever of the known formats it has, in one file or in many.

    Parameters
    ----------
    path
        An rfpose-iq file; a Digital RF directory, whose channels are the receivers; SigMF: a ``.sigmf-meta`` file, a
        directory of them, an archive (compressed, too) or a collection; a WAV file of IQ; a file of GNU Radio with its
        detached header (``.hdr``); a manifest (``recording.toml``) or the directory of one; a directory of several of
        these; or a list of all these. Several are one recording: receivers apart, one after the other in time, or both.
    scenario
        The site, in place of the one found in the recording. It is not compared with the recording here; see
        `check_against`.
    declared
        What a file of raw samples or a WAV file does not say of itself; for every file that is given.
    follow_links
        Read what the recording names outside its own folder, too: links in the file system, SigMF's ``core:dataset``,
        HDF5's external links, external storage and virtual datasets, files of a manifest. A recording from elsewhere
        could so make any file be read.

    Raises
    ------
    RecordingError
        Nothing there, another format, damaged, or a library for the format is not installed. The message
        names the file, the place inside it and the remedy. Of several parts those that cannot be read are left out and
        told in `Recording.notes`; parts that contradict each other are refused.
    ScenarioError
        The embedded scenario is malformed.

    Examples
    --------
    >>> import rfpose as rf
    >>> with rf.open_recording("night.h5") as recording:  # doctest: +SKIP
    ...     recording.plot()
    """
    if not isinstance(path, str | Path):
        given = [_named(each) for each in path]
        if not given:
            raise InvalidInputError("`path` must name at least one recording")
        if len(given) > 1:
            return _open_set(given, scenario=scenario, declared=declared, follow_links=follow_links)
        path = given[0]
    path = _named(path)
    _refuse_missing(path)
    if declared is None:
        if path.is_dir() and (path / MANIFEST_FILE).is_file():
            path = path / MANIFEST_FILE
        if is_manifest(path):
            return _open_manifest(path, scenario=scenario, follow_links=follow_links)
        if path.is_dir():
            found = _found_in(path)
            if found and found != [path]:
                return _open_set(found, scenario=scenario, declared=None, follow_links=follow_links, whole=path)
            return _open_folder(path, scenario, follow_links=follow_links)
    return _open_one(path, scenario, declared=declared, follow_links=follow_links)


def files_of(path: RecordingSource) -> list[Path]:
    """Return what would be read as a recording, before it is opened: nothing else may be written there."""
    found: list[Path] = []
    for one in [path] if isinstance(path, str | Path) else path:
        one = Path(one)
        found += [one, *members(one)]
        manifest = one / MANIFEST_FILE if one.is_dir() else one
        if is_manifest(manifest):
            try:
                read = read_manifest(manifest, follow_links=True)
            except RecordingError:  # said when it is opened
                continue
            named = [entry.path for entry in read.entries] + ([] if read.scenario is None else [read.scenario])
            found += [file for entry in named for file in (entry, *members(entry))]
        elif one.is_dir():
            found += [file for part in _found_in(one) if part != one for file in (part, *members(part))]
    return found


def _named(path: str | Path) -> Path:
    """Return a path that ends in a name, by which results and messages call it; ``.`` has none."""
    path = Path(path)
    return path if path.name else path.absolute()


def _refuse_missing(path: Path) -> None:
    try:
        exists = path.exists()
    except (OSError, ValueError) as error:  # too long, or with a zero byte
        raise RecordingError(f"{str(path)!r:.200}: no path of a file ({error!s:.60}); check the path") from error
    if not exists:
        raise RecordingError(f"{path}: no such file or directory; check the path")


def _open_one(path: Path, scenario: Scenario | None, *, declared: Declared | None, follow_links: bool) -> Recording:
    """Open what is one recording in one format."""
    _refuse_missing(path)
    if declared is not None and declared.format == "raw":
        return RawRecording(path, scenario=scenario, declared=declared)
    if declared is not None or is_wav(path):
        return WavRecording(path, scenario=scenario, declared=declared, follow_links=follow_links)
    if path.is_dir():
        return _open_directory(path, scenario, follow_links=follow_links)
    for header in (path.with_name(f"{path.name}.hdr"), path):
        if is_gnuradio_header(header):
            return GnuRadioRecording(header, scenario=scenario, follow_links=follow_links)
    if path.name.endswith(SIGMF_ENDINGS):
        from rfpose.recording.sigmf_files import SigmfRecording

        return SigmfRecording(path, scenario=scenario, follow_links=follow_links)
    return NativeRecording(path, scenario=scenario, follow_links=follow_links)


def _open_folder(path: Path, scenario: Scenario | None, *, follow_links: bool) -> Recording:
    """Open a directory as one recording; of SigMF recordings that are unlike, as their parts."""
    try:
        return _open_one(path, scenario, declared=None, follow_links=follow_links)
    except UnlikeError:
        metas = _metas(path)
        if len(metas) > 1:
            with contextlib.suppress(RecordingError):  # if none can be read apart, why not as one is told
                return _open_set(metas, scenario=scenario, declared=None, follow_links=follow_links, whole=path)
        raise


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
        "(*.sigmf-meta) nor other recordings; check the path"
    )


# -- sets ----------------------------------------------------------------------------------------------------


def _found_in(path: Path) -> list[Path]:
    """Return the recordings in a directory: itself where it is one, files in it, directories in it that are one."""
    if (path / "drf_properties.h5").exists():
        return []
    is_drf, metas = any(path.glob("*/drf_properties.h5")), sorted(path.glob("*.sigmf-meta"))
    found = [path] if is_drf or metas else []
    found += metas if is_drf else []
    found += sorted(file for pattern in _IN_A_SET for file in path.glob(pattern) if _is_part(file))
    for folder in sorted(path.iterdir()):
        is_channel = (folder / "drf_properties.h5").exists()
        if folder.is_dir() and not folder.is_symlink() and not is_channel and not folder.name.startswith("."):
            found += [folder] if any(folder.glob("*/drf_properties.h5")) or any(folder.glob("*.sigmf-meta")) else []
    return list(dict.fromkeys(found))


def _is_part(file: Path) -> bool:
    """Whether a file in a directory is a recording, and not a result or something else of the same ending."""
    if not file.is_file():
        return False
    if file.suffix == ".hdr":
        return is_gnuradio_header(file)
    return file.suffix not in (".h5", ".hdf5") or kind_of(file) == "recording" or _is_cut_off(file)


def _is_cut_off(file: Path) -> bool:
    """Whether a file of HDF5 cannot be opened, or is empty: then it may have been a recording, and is named."""
    if not is_hdf5(file):
        return file.stat().st_size == 0
    try:
        with open_hdf5(file):
            return False
    except (OSError, RuntimeError):
        return True


def _apart(path: Path, *, follow_links: bool) -> list[Path]:
    """Return a directory of SigMF recordings if they are read as one; else each: they are unlike, or damaged."""
    metas = _metas(path)
    if len(metas) > 1:
        with contextlib.suppress(ScenarioError):  # of the scenario.toml beside them, which their reader tells
            try:
                _open_one(path, None, declared=None, follow_links=follow_links).close()
            except RecordingError:
                return metas
    return [path]


def _metas(path: Path) -> list[Path]:
    """Return the SigMF recordings that a directory is read as, none where it is one of Digital RF."""
    return [] if any(path.glob("*/drf_properties.h5")) else sorted(path.glob("*.sigmf-meta"))


def _open_set(
    given: Sequence[Path],
    *,
    scenario: Scenario | None,
    declared: Declared | None,
    follow_links: bool,
    whole: Path | None = None,
) -> Recording:
    """Open several paths as one recording; ``whole`` is the directory that was given for them."""
    paths: list[Path] = []
    for path in given:
        if is_manifest(path):
            raise RecordingError(
                f"{path}: a manifest stands for a whole recording; give it alone, or write all into it"
            )
        inner = _found_in(path) if path.is_dir() and declared is None and path != whole else [path]
        for one in inner or [path]:
            paths += _apart(one, follow_links=follow_links) if one.is_dir() and declared is None else [one]
    paths = list(dict.fromkeys(paths))
    names = _short_names(paths, within=whole)
    parts = [Part(name=names[path], open=_opener(path, declared=declared, follow_links=follow_links)) for path in paths]
    more = f" and {len(given) - 1} more"
    return PartsRecording(
        whole if whole is not None else given[0].with_name(given[0].name + more),
        parts,
        names=(whole.name,) if whole is not None else tuple(path.name for path in given),
        scenario=scenario,
    )


def _open_manifest(path: Path, *, scenario: Scenario | None, follow_links: bool) -> Recording:
    manifest = read_manifest(path, follow_links=follow_links)
    if scenario is None and manifest.scenario is not None:
        scenario = load_scenario(manifest.scenario)
    notes = list(manifest.notes)
    names = _short_names([entry.path for entry in manifest.entries], within=path.parent)
    parts = []
    for entry in manifest.entries:
        receivers = entry.receivers
        opener = _opener(entry.path, declared=entry.declared, follow_links=follow_links)
        if isinstance(receivers, tuple):
            receivers = _in_order(opener, receivers, names[entry.path], notes)
        parts.append(
            Part(
                name=names[entry.path],
                open=opener,
                receivers=receivers,
                offset_s=entry.offset_s if entry.offset_s is not None else Fraction(0),
                find_offset=entry.offset_s is None,
                start_s=entry.start_s,
            )
        )
    return PartsRecording(path, parts, names=(path.name,), scenario=scenario, notes=notes)


def _in_order(
    opener: Callable[[Scenario | None], Recording], receivers: Sequence[str], name: str, notes: list[str]
) -> dict[str, str] | None:
    """Return names by the part's own, in its order."""
    try:
        with opener(None) as recording:
            own = recording.receiver_ids
    except RecordingError:  # told when the whole is opened
        return None
    if len(own) != len(receivers):
        notes.append(f"{name} has {len(own)} receivers ({', '.join(own[:4])}), the manifest names {len(receivers)}")
    return dict(zip(own, receivers, strict=False))


def _opener(path: Path, *, declared: Declared | None, follow_links: bool) -> Callable[[Scenario | None], Recording]:
    def opened(scenario: Scenario | None) -> Recording:
        return _open_one(path, scenario, declared=declared, follow_links=follow_links)

    return opened


def _short_names(paths: Iterable[Path], *, within: Path | None) -> dict[Path, str]:
    """Return what to call parts: short, and each its own."""
    paths = list(paths)
    if within is not None:
        inner = {path: str(path.relative_to(within)) for path in paths if path.is_relative_to(within)}
        return {path: f"{path.name}/" if path == within else inner.get(path, str(path)) for path in paths}
    short = [path.name for path in paths]
    return {path: path.name if short.count(path.name) == 1 else str(path) for path in paths}
