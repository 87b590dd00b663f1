"""Made scenes, each rendered once and kept in a folder."""

import errno
import hashlib
import json
import re
from collections.abc import Generator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from torchrefrac.files.paths import user_cache
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.synthetic.folder import image_names, render_into
from torchrefrac.synthetic.options import SyntheticOptions
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.rehearsal import rehearse
from torchrefrac.synthetic.scenes import stage_of
from torchrefrac.synthetic.stage import Stage, StageError

VERSION = 1
"""Of what is rendered from the same options. Raise it whenever that changes: folders of before are then left alone."""

FULL = (errno.ENOSPC, errno.EDQUOT)
FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


def made_scene(options: SyntheticOptions, cache: Path | None = None, recorder: Recorder | None = None) -> Path:
    """Folder of the scene that `options` describe, a capture with its truth; rendered unless `cache` has it already.

    By default `cache` is the folder of the environment variable TORCHREFRAC_CACHE, or torchrefrac/ in the user's cache.
    Raises StageError, one sentence with the remedy, where the scene cannot be made or written.
    """
    cache = cache or user_cache()
    folder = scene_folder(options, cache)
    return folder if folder.is_dir() else render_scene(stage_of(options), options, cache, recorder or SilentRecorder())


def scene_folder(options: SyntheticOptions, cache: Path) -> Path:
    """Where in `cache` the scene of these options lies, or would lie: NAME_HASH."""
    text = json.dumps([VERSION, options.fingerprint()], sort_keys=True)
    name = re.sub(r"[^\w.-]+", "_", options.name)
    return cache / f"{name}_{hashlib.sha256(text.encode('utf-8')).hexdigest()[:12]}"


def render_scene(stage: Stage, options: SyntheticOptions, cache: Path, recorder: Recorder) -> Path:
    """The folder of the scene in `cache`, a capture with truth beside it; rendered unless it is there already.

    `stage` must be what `options` say: the options alone decide whether the scene is there. While the scene is being
    rendered its folder has another name; when that is interrupted, the next try goes on with the images that are whole.
    A second process that wants the same scene waits for the first.

    Raises StageError, one sentence with the remedy, where the scene cannot be photographed (see `rehearse`) or the
    folder cannot be written.
    """
    folder = scene_folder(options, cache)
    photographers = Photographer.each(stage, options)
    rehearse(photographers, options, image_names(len(stage.center)))
    with _explained(folder, cache):
        cache.mkdir(parents=True, exist_ok=True)
        with _alone(folder, recorder):
            if not folder.is_dir():
                partial = folder.with_name(f"{folder.name}.partial")
                render_into(partial, photographers, options, VERSION, recorder)
                partial.rename(folder)
    return folder


def _alone(folder: Path, recorder: Recorder) -> AbstractContextManager[object]:
    """Wait until no other process renders this scene."""
    lock = FileLock(folder.with_name(f".{folder.name}.lock"))
    try:
        return lock.acquire(timeout=0)
    except Timeout:
        recorder.note(f"another process is rendering {folder.name}; waiting for it")
        return lock.acquire()


@contextmanager
def _explained(folder: Path, cache: Path) -> Generator[None, None, None]:
    """OSErrors as what they mean for the user."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        remedy = "give another cache folder (option `cache`)"
        if error.errno in FULL:
            reason, remedy = "the disk is full", f"free space, or {remedy}; images that are finished are kept"
        elif error.errno in FORBIDDEN:
            reason, remedy = "no permission to write there", f"allow writing to {cache}, or {remedy}"
        raise StageError(f"{folder} cannot be written: {reason}; {remedy}") from error
