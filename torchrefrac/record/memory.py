"""How much memory the process has needed since some moment."""

import sys
from pathlib import Path

GIB = 1 << 30
CLEAR, STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")
PEAK_IS_NOW = "5"  # see proc(5)


def forget_peak_memory() -> None:
    """Begin to measure again, where the system can do that (Linux); else the peak is that since the process began."""
    try:
        CLEAR.write_text(PEAK_IS_NOW, encoding="ascii")
    except OSError:
        return


def peak_memory_gib() -> float | None:
    """The largest resident memory since, in GiB; None where the system does not say."""
    try:
        lines = STATUS.read_text(encoding="ascii").splitlines()
    except OSError:
        return _since_the_beginning()
    peak = next((line.split()[1] for line in lines if line.startswith("VmHWM:")), None)
    return None if peak is None else int(peak) * 1024 / GIB


def _since_the_beginning() -> float | None:
    try:
        import resource  # noqa: PLC0415 - not on every system
    except ImportError:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / GIB
