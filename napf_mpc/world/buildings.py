"""Buildings of a city file as vertical prisms: what the readers of all formats share."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import shapely
from numpy.typing import NDArray

from napf_mpc.data_file import readable_file
from napf_mpc.errors import DataError
from napf_mpc.world.shapes import Prism

Array = NDArray[np.float64]

MAX_FILE_BYTES = 200_000_000
"""Larger files are refused."""

MIN_AREA_M2 = 0.01
"""Footprints and courtyards smaller than this are degenerate: rounding, not architecture."""


@dataclass(frozen=True, eq=False)
class Buildings:
    """Buildings of a file in the local frame.

    Parameters
    ----------
    prisms : tuple of Prism
        One for each connected footprint.
    names : tuple of str
        Name of the building that each prism belongs to.
    origin : tuple of float
        Where the local frame lies: latitude and longitude [deg] (GeoJSON), or easting, northing and height in
        the file's own coordinates [m] (CityJSON).
    """

    prisms: tuple[Prism, ...]
    names: tuple[str, ...]
    origin: tuple[float, ...]


@dataclass(frozen=True)
class Block:
    """One building as read: its name, footprint in the local frame (any geometry) and heights."""

    name: str
    footprint: shapely.Geometry
    base_m: float
    top_m: float


def cut_into_prisms(
    path: Path,
    blocks: list[Block],
    origin: tuple[float, ...],
    min_height_m: float,
    radius_m: float,
    read: int | None = None,
) -> Buildings:
    """Filter buildings by height and distance from the origin and make a prism of each of their parts.

    ``read`` is how many there were if some are not among the blocks, as what lies behind the earth.

    Raises
    ------
    DataError
        If no building is left.
    """
    here = shapely.Point(0.0, 0.0)
    prisms: list[Prism] = []
    names: list[str] = []
    for block in blocks:
        if block.top_m - block.base_m < min_height_m or shapely.distance(block.footprint, here) > radius_m:
            continue
        for part in polygons_of(block.footprint):
            if part.area < MIN_AREA_M2:
                continue
            try:
                prisms.append(Prism(_rings(part), block.base_m, block.top_m))
            except ValueError as error:
                raise DataError(f"{path}: {block.name}: {error}") from error
            names.append(block.name)
    if not prisms:
        count = len(blocks) if read is None else read
        raise DataError(
            f"{path}: none of its buildings is left: {count} were read, none has {MIN_AREA_M2:g} m2, "
            f"min_height_m = {min_height_m:g} and lies within radius_m = {radius_m:g} of the origin "
            f"({', '.join(f'{value:g}' for value in origin)}); change the filters or the origin"
        )
    return Buildings(tuple(prisms), tuple(names), origin)


def polygons_of(geometry: shapely.Geometry) -> Iterator[shapely.Polygon]:
    """Polygons of any geometry, however deep its collections; points and lines have no area and are left."""
    if isinstance(geometry, shapely.Polygon):
        if not geometry.is_empty:
            yield geometry
    elif isinstance(geometry, (shapely.MultiPolygon, shapely.GeometryCollection)):
        for part in geometry.geoms:
            yield from polygons_of(part)


def _rings(polygon: shapely.Polygon) -> tuple[Array, ...]:
    holes = [hole for hole in polygon.interiors if shapely.Polygon(hole).area >= MIN_AREA_M2]
    return tuple(np.asarray(ring.coords)[:-1, :2] for ring in (polygon.exterior, *holes))


def read_json(path: Path) -> Any:
    """Parse a file of at most `MAX_FILE_BYTES`; whatever is wrong with it is a DataError."""
    readable_file(path, MAX_FILE_BYTES)
    try:
        return json.loads(path.read_bytes(), parse_constant=_refuse_constant)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    except RecursionError as error:
        raise DataError(f"{path}: is nested too deeply") from error
    except ValueError as error:
        raise DataError(f"{path}: is not JSON: {error}") from error


def _refuse_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is not a number")


def point_array(where: str, values: Any, columns: tuple[int, ...]) -> Array:
    """Turn a list of positions into an array (point, column), all finite numbers."""
    try:
        array = np.array(values)
    except ValueError:
        array = np.array(None)
    if array.ndim != 2 or array.shape[1] not in columns or array.dtype.kind not in "iuf":
        wanted = " or ".join(str(count) for count in columns)
        raise DataError(f"{where} must be a list of positions of {wanted} numbers each")
    if not np.isfinite(array).all():
        raise DataError(f"{where} has a number that is not finite")
    return array.astype(np.float64)


def check_origin(path: Path, name: str, origin: Any, axes: tuple[str, ...]) -> None:
    """Refuse an origin that is not one finite number an axis."""
    try:
        values = np.array(origin, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.array(math.nan)
    if values.shape != (len(axes),) or not np.isfinite(values).all():
        raise DataError(
            f"{path}: {name} = {shown(origin)}, must be {len(axes)} finite numbers: {', '.join(axes)}"
        )


def shown(value: Any) -> str:
    """Short text of a value for a message."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
