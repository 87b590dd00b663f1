"""Coordinate reference systems by their names, as pyproj knows them."""

from typing import Any


def same_map(first: str, second: str) -> bool:
    """Whether two systems have the same horizontal part; heights may count from different places, which only who made
    the files can know. Raises ValueError where pyproj does not know one of them."""
    return _horizontal(first).equals(_horizontal(second), ignore_axis_order=True)


def map_name(system: str) -> str:
    """What people call it."""
    return _horizontal(system).name


def length_unit(system: str | None) -> str:
    """What coordinates count, where their system is known: "m", else any "unit"."""
    if system is None:
        return "unit"
    axes = _horizontal(system).axis_info
    return "m" if axes and all(axis.unit_name == "metre" for axis in axes) else "unit"


def system_of(crs: str) -> Any:
    """pyproj's own of a system. Raises ValueError where it does not know it."""
    from pyproj import CRS  # noqa: PLC0415 - of an extra
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        return CRS.from_user_input(crs)
    except CRSError as error:
        raise ValueError(f"crs is {crs!r}, which is no coordinate reference system: {error}") from None


def horizontal_part(system: Any) -> Any:
    """Of pyproj's systems, of which some have one of heights beside it."""
    return system.sub_crs_list[0] if system.is_compound else system


def _horizontal(crs: str) -> Any:
    return horizontal_part(system_of(crs)).to_2d()
