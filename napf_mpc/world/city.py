"""Real buildings around the path: city files by their ending, and GeoJSON footprints with heights.

Buildings become vertical prisms in a local east-north-up frame in metres. **The ground is flat**: GeoJSON
buildings stand on height 0 whatever the terrain, and the earth's curvature (0.1 m at 1 km, 2 m at 5 km) is
left out. Nothing that a file calls a building is skipped because it is malformed: a building left out in
silence is one flown into.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import shapely

from napf_mpc.data_folder import find_data_file
from napf_mpc.errors import DataError
from napf_mpc.problem import City
from napf_mpc.world.buildings import (
    Array,
    Block,
    Buildings,
    check_origin,
    cut_into_prisms,
    point_array,
    read_json,
    shown,
)
from napf_mpc.world.cityjson import read_cityjson
from napf_mpc.world.obstacles import ObstacleSet

__all__ = ["Buildings", "load_city", "read_cityjson", "read_geojson"]

_FAR_SIDE_M = -1e6
# WGS 84 and what lies within two metres of it: ETRS89, NAD83, JGD2000, JGD2011, KGD2002, CGCS2000, SIRGAS
# 2000, GDA94, GDA2020, NZGD2000; of each the plane and the three-dimensional system.
_LIKE_WGS84 = {
    "CRS84", "CRS84h", "4326", "4979", "4258", "4937", "4269", "4957", "4612", "4947", "6668", "6667", "6697",
    "4737", "4927", "4490", "4480", "4674", "4989", "4283", "4939", "7844", "7843", "4167", "4959",
}  # fmt: skip


def load_city(world: City, data_folder: Path | None = None) -> ObstacleSet:
    """Read the buildings of a world of kind ``city`` as one scene.

    The file's ending decides the format: ``.geojson``, or ``.json`` for CityJSON. A file that was read before
    and has not changed since is not read again.

    Parameters
    ----------
    world : City
        File, origin and filters.
    data_folder : Path, optional
        Where the file is looked for, see `napf_mpc.data_folder.find_data_file`.

    Returns
    -------
    ObstacleSet
        One scene of prisms.

    Raises
    ------
    DataError
        If the file is missing or not usable, or if no building is left.
    """
    path = find_data_file(world.file, data_folder)
    stat = path.stat()
    return _load_cached(world, path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4)
def _load_cached(world: City, path: Path, _changed_ns: int, _size: int) -> ObstacleSet:
    if path.suffix.lower() == ".geojson":
        if world.origin_m is not None:
            raise DataError(
                f"{path}: world.origin_m is for CityJSON; a GeoJSON file takes world.origin_latitude_deg and "
                "world.origin_longitude_deg"
            )
        origin = None
        if world.origin_latitude_deg is not None and world.origin_longitude_deg is not None:
            origin = (world.origin_latitude_deg, world.origin_longitude_deg)
        buildings = read_geojson(
            path,
            origin_deg=origin,
            height_property=world.height_property,
            min_height_m=world.min_height_m,
            radius_m=world.radius_m,
        )
    elif path.suffix.lower() == ".json":
        if world.origin_latitude_deg is not None:
            raise DataError(
                f"{path}: world.origin_latitude_deg is for GeoJSON; a CityJSON file takes world.origin_m in "
                "its own projected coordinates"
            )
        buildings = read_cityjson(
            path, origin_m=world.origin_m, min_height_m=world.min_height_m, radius_m=world.radius_m
        )
    else:
        raise DataError(f"{path}: a city file must end in .geojson, or in .json for CityJSON")
    return ObstacleSet.from_shapes(buildings.prisms)


def read_geojson(
    path: Path | str,
    *,
    origin_deg: tuple[float, float] | None = None,
    height_property: str = "height_m",
    min_height_m: float = 0.0,
    radius_m: float = math.inf,
) -> Buildings:
    """Read building footprints with heights from GeoJSON (RFC 7946: WGS-84 longitude, latitude).

    Each Polygon or part of a MultiPolygon becomes a prism from 0 to its height, with its courtyards. A
    footprint that crosses itself is repaired by the even-odd rule; one under 0.01 m2 has no inside and is
    dropped.

    Parameters
    ----------
    path : Path or str
        The file, a FeatureCollection.
    origin_deg : (latitude, longitude), optional
        Origin of the local frame; by default the middle of all buildings of the file.
    height_property : str
        Name of the property with the height above ground [m].
    min_height_m : float
        Lower buildings are left out [m].
    radius_m : float
        Footprints that lie altogether farther than this from the origin are left out [m].

    Returns
    -------
    Buildings
        Prisms in metres east and north of the origin.

    Raises
    ------
    DataError
        If the file, a feature, a coordinate, a height or the origin is not usable, or no building is left.
    """
    path = Path(path)
    document = read_json(path)
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        raise DataError(f'{path}: not a GeoJSON FeatureCollection ("type" must be "FeatureCollection")')
    _check_wgs84(path, document.get("crs"))
    features = document.get("features")
    if not isinstance(features, list) or not features:
        raise DataError(f'{path}: "features" must be a list with at least one building')
    names = [_feature_name(i, feature) for i, feature in enumerate(features)]
    heights = [
        _feature_height(f"{path}: {name}", feature, height_property)
        for name, feature in zip(names, features, strict=True)
    ]
    polygons = [
        _feature_polygons(f"{path}: {name}", feature) for name, feature in zip(names, features, strict=True)
    ]
    flat = np.concatenate([ring for rings in chain.from_iterable(polygons) for ring in rings])
    if origin_deg is not None:
        check_origin(path, "origin_deg", origin_deg, ("latitude", "longitude"))
    else:
        origin_deg = _middle_deg(flat)
    east, north, up = pymap3d.geodetic2enu(flat[:, 1], flat[:, 0], 0.0, *origin_deg, 0.0)
    # The plane cannot tell the far side of the earth from the near one; no filter may bring it close.
    plane = np.where((up < _FAR_SIDE_M)[:, None], np.inf, np.stack([east, north], axis=-1))
    blocks = []
    at = 0
    for name, height, parts in zip(names, heights, polygons, strict=True):
        for rings in parts:
            local = []
            for ring in rings:
                local.append(plane[at : at + len(ring)])
                at += len(ring)
            if all(np.isfinite(ring).all() for ring in local):
                footprint = shapely.make_valid(shapely.Polygon(local[0], local[1:]))
                blocks.append(Block(name, footprint, 0.0, height))
    read = sum(len(parts) for parts in polygons)
    return cut_into_prisms(path, blocks, origin_deg, min_height_m, radius_m, read)


def _middle_deg(points: Array) -> tuple[float, float]:
    """Latitude and longitude in the middle of positions (n, 2), on both sides of 180 degrees, too."""
    low, high = points.min(axis=0), points.max(axis=0)
    if high[0] - low[0] > 180.0:  # GeoJSON cuts at the antimeridian: what lies west of it goes on beyond 180
        longitude = np.mod(points[:, 0], 360.0)
        low[0], high[0] = longitude.min(), longitude.max()
    longitude_deg, latitude_deg = (0.5 * (low + high)).tolist()
    return latitude_deg, longitude_deg if longitude_deg <= 180.0 else longitude_deg - 360.0


def _check_wgs84(path: Path, system: Any) -> None:
    """Refuse a file that names a projected system, as GeoJSON before RFC 7946 might."""
    properties = system.get("properties") if isinstance(system, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if system is not None and (not isinstance(name, str) or re.split("[:/]", name)[-1] not in _LIKE_WGS84):
        raise DataError(
            f"{path}: crs {shown(name if name is not None else system)} is not WGS-84; GeoJSON must be in "
            "longitude, latitude of EPSG:4326: convert it"
        )


def _feature_name(index: int, feature: Any) -> str:
    properties = feature.get("properties") if isinstance(feature, dict) else None
    for holder in (properties, feature):
        if isinstance(holder, dict) and isinstance(holder.get("id"), (str, int)):
            return f"feature {index} (id {shown(holder['id'])})"
    return f"feature {index}"


def _feature_height(where: str, feature: Any, height_property: str) -> float:
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise DataError(f'{where}: "type" must be "Feature"')
    properties = feature.get("properties")
    if not isinstance(properties, dict) or height_property not in properties:
        raise DataError(
            f'{where}: has no property "{height_property}"; name the one that holds the height in '
            "world.height_property"
        )
    height = properties[height_property]
    if isinstance(height, bool) or not isinstance(height, (int, float)) or not 0.0 < height < 1e5:
        raise DataError(f"{where}: {height_property} = {shown(height)}, must be a number > 0 and < 1e5 [m]")
    return float(height)


def _feature_polygons(where: str, feature: dict[str, Any]) -> list[list[Array]]:
    """Polygons of a feature, each a list of rings of (longitude, latitude) [deg]."""
    geometry = feature.get("geometry")
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in ("Polygon", "MultiPolygon") or not isinstance(geometry, dict):
        raise DataError(f"{where}: geometry is {shown(kind)}, must be a Polygon or a MultiPolygon")
    polygons = geometry.get("coordinates")
    polygons = [polygons] if kind == "Polygon" else polygons
    if not isinstance(polygons, list) or not polygons:
        raise DataError(f"{where}: geometry has no coordinates")
    for polygon in polygons:
        if not isinstance(polygon, list) or not polygon:
            raise DataError(f"{where}: a polygon must be a list of rings")
    return [[_ring_deg(where, ring) for ring in polygon] for polygon in polygons]


def _ring_deg(where: str, ring: Any) -> Array:
    points = point_array(f"{where}: a ring", ring, (2, 3))
    if len(points) < 4:
        raise DataError(f"{where}: a ring has {len(points)} positions, must have at least 4")
    outside = (np.abs(points[:, 0]) > 180.0) | (np.abs(points[:, 1]) > 90.0)
    if outside.any():
        raise DataError(
            f"{where}: position {points[outside][0, :2].tolist()} is not longitude, latitude in degrees; "
            "GeoJSON must be WGS-84"
        )
    return points[:, :2]
