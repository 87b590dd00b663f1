"""Clocks of cameras: what is odd about the times of photographs in the order of their names."""

from collections.abc import Sequence
from datetime import datetime, timedelta
from itertools import pairwise

FORMAT = "%Y:%m:%d %H:%M:%S"
FIRST_YEAR = 2000  # a clock that was never set begins before, or then
TOLERANCE = timedelta(seconds=2)  # in which bursts may be written in any order
MOST_DAYS = 1  # after which the water may stand at another level


def odd_times(times: Sequence[str], names: Sequence[str]) -> list[str]:
    """Sentences on clocks that jump back, were never set, and on photographs of several days."""
    taken = [(_parsed(time), name) for time, name in zip(times, names, strict=True)]
    known = [(time, name) for time, name in taken if time is not None]
    notes = [f"{name}: its clock was not set ({time.year})" for time, name in known if time.year <= FIRST_YEAR][:1]
    for (before, _), (after, name) in pairwise(known):
        if before - after > TOLERANCE:
            asked = "was the clock set, or are these several flights?"
            notes.append(f"{name} is earlier than the one before it by {before - after}: {asked}")
            break
    days = (max(known)[0] - min(known)[0]).days if known else 0
    if days >= MOST_DAYS:
        remedy = "where the water rose or fell meanwhile, epoch_gap_hours=6 tells the days apart"
        notes.append(f"the photographs were taken over {days} days; {remedy}")
    return notes


def epochs_of(times: Sequence[str], gap_hours: float) -> list[str]:
    """The epoch of each photograph, by the time of its first one, where so many hours lie between them. One without a
    time is of the epoch of the one before it; none are of any where there is one epoch."""
    known = sorted({time for time in map(_parsed, times) if time is not None})
    first = [after for before, after in pairwise(known) if after - before > timedelta(hours=gap_hours)]
    if not first:
        return []
    starts, found, last = [known[0], *first], [], known[0]
    for time in map(_parsed, times):
        last = last if time is None else max(start for start in starts if start <= time)
        found.append(f"{last:%Y-%m-%d %H:%M}")
    return found


def _parsed(time: str) -> datetime | None:
    try:
        return datetime.strptime(time[:19], FORMAT)
    except ValueError:
        return None
