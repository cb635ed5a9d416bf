"""CityJSON block models (LoD1) as vertical prisms."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from napf_mpc.errors import DataError
from napf_mpc.world.buildings import (
    Array,
    Block,
    Buildings,
    check_origin,
    cut_into_prisms,
    point_array,
    polygons_of,
    read_json,
    shown,
)
from napf_mpc.world.foot_systems import FOOT_SYSTEMS

_BUILDINGS = ("Building", "BuildingPart")
_GEOGRAPHIC = ("4326", "4979", "CRS84")
# EPSG/0/7415, EPSG::7415, EPSG:28992+5709: perhaps a version, then a code or some.
_EPSG_CODES = re.compile(r"EPSG[:/](?:[^:/+]*[:/])?(\d{1,9}(?:\+\d{1,9})*)", re.IGNORECASE)
_LEAST_WIDTH_M = 0.5
_FEET = re.compile(r"\b(?:ft|ftUS|foot|feet)\b", re.IGNORECASE)
# How many lists lie around a surface (a list of rings) in a geometry's boundaries.
_SURFACE_DEPTH = {
    "MultiSurface": 1,
    "CompositeSurface": 1,
    "Solid": 2,
    "MultiSolid": 3,
    "CompositeSolid": 3,
}


def read_cityjson(
    path: Path | str,
    *,
    origin_m: tuple[float, float, float] | None = None,
    min_height_m: float = 0.0,
    radius_m: float = math.inf,
) -> Buildings:
    """Read the buildings of a CityJSON file (1.0 to 2.0) as blocks.

    Only objects of type Building and BuildingPart are read. The file's coordinates are **assumed to be
    projected and metric**, as in EPSG:7415, since such a file does not say its unit but by the name of its
    system. Refused are the commonest geographic systems (EPSG:4326 and 4979, CRS84) and all of EPSG that are
    in feet, and files whose widest building is less than 0.5 wide, as in degrees. Other units (yards,
    chains), systems of other registers (such as ESRI) and files that name none are **not** known, and read
    as metres. Of an object's geometries the one of LoD1 is taken if there is one, else the lowest above LoD0;
    an object without one stands for its parts, which must be there. Its footprint is the union of its faces
    seen from above, its base the lowest and its top the highest of its vertices, so that the block holds the
    building whatever its roof is.

    Parameters
    ----------
    path : Path or str
        The file.
    origin_m : (x, y, z), optional
        Origin of the local frame in the file's coordinates; by default the middle of all buildings of the
        file and the lowest base of any.
    min_height_m : float
        Buildings whose top lies less than this above their base are left out [m].
    radius_m : float
        Footprints that lie altogether farther than this from the origin are left out [m].

    Returns
    -------
    Buildings
        Prisms in metres about the origin, heights too.

    Raises
    ------
    DataError
        If the file, its reference system, an object, a vertex or the origin is not usable, or no building is
        left.
    """
    path = Path(path)
    document = read_json(path)
    if not isinstance(document, dict) or document.get("type") != "CityJSON":
        raise DataError(f'{path}: not a CityJSON file ("type" must be "CityJSON")')
    _check_metric(path, document)
    vertices = _cityjson_vertices(path, document)
    objects = document.get("CityObjects")
    if not isinstance(objects, dict):
        raise DataError(f'{path}: "CityObjects" must be an object')
    solids = []
    for key, item in objects.items():
        name = f"building {shown(key)}"
        where = f"{path}: {name}"
        if not isinstance(item, dict) or not isinstance(item.get("type"), str):
            raise DataError(f'{path}: object {shown(key)} has no "type"')
        if item["type"] in _BUILDINGS and not _stands_for_parts(where, item, objects):
            surfaces = _building_surfaces(where, item)
            indices = np.unique(np.concatenate([ring for surface in surfaces for ring in surface]))
            if indices[-1] >= len(vertices):
                raise DataError(f"{where}: a boundary names vertex {indices[-1]} of {len(vertices)}")
            solids.append((name, surfaces, vertices[indices]))
    if not solids:
        raise DataError(f"{path}: holds no object of type Building or BuildingPart with a geometry")
    if origin_m is not None:
        check_origin(path, "origin_m", origin_m, ("x", "y", "z"))
    else:
        lower = np.min([corners.min(axis=0) for _, _, corners in solids], axis=0)
        upper = np.max([corners.max(axis=0) for _, _, corners in solids], axis=0)
        x, y, _ = (0.5 * (lower + upper)).tolist()
        origin_m = (x, y, float(lower[2]))
    _check_width(path, [corners for _, _, corners in solids])
    local = vertices - np.array(origin_m)
    blocks = []
    for name, surfaces, corners in solids:
        base, top = float(corners[:, 2].min()) - origin_m[2], float(corners[:, 2].max()) - origin_m[2]
        if not base < top:
            raise DataError(f"{path}: {name} has no height: all its vertices lie at {base + origin_m[2]:g} m")
        footprint = _seen_from_above(local[:, :2], surfaces)
        if footprint.area <= 0.0:
            raise DataError(f"{path}: {name} has no floor and no roof: its faces enclose nothing from above")
        blocks.append(Block(name, footprint, base, top))
    return cut_into_prisms(path, blocks, origin_m, min_height_m, radius_m)


def _check_metric(path: Path, document: dict[str, Any]) -> None:
    metadata = document.get("metadata", {})
    system = metadata.get("referenceSystem") if isinstance(metadata, dict) else None
    if not isinstance(system, str):
        return
    if system.replace(":", "/").split("/")[-1] in _GEOGRAPHIC:
        raise DataError(f"{path}: referenceSystem {shown(system)} is geographic; coordinates must be metric")
    codes = {int(code) for found in _EPSG_CODES.findall(system) for code in found.split("+")}
    if codes & FOOT_SYSTEMS or _FEET.search(system):
        raise DataError(
            f"{path}: referenceSystem {shown(system)} is in feet; coordinates must be metric: convert it"
        )


def _check_width(path: Path, solids: list[Array]) -> None:
    """Refuse degrees, whatever the file calls its system: no building is a degree wide, each is a metre."""
    widest = max(float(np.ptp(corners[:, :2], axis=0).max()) for corners in solids)
    if widest < _LEAST_WIDTH_M:
        raise DataError(
            f"{path}: its widest building measures {widest:.3g}, as in degrees; coordinates must be metric: "
            "convert it to a projected system"
        )


def _cityjson_vertices(path: Path, document: dict[str, Any]) -> Array:
    vertices = point_array(f'{path}: "vertices"', document.get("vertices"), (3,))
    # Since 1.1 vertices are whole numbers of some unit, and without it they are not metres.
    whole = (vertices == np.round(vertices)).all() and "transform" not in document
    if whole and not str(document.get("version", "1.0")).startswith(("0.", "1.0")):
        raise DataError(f'{path}: version {shown(document["version"])} needs "transform"')
    if "transform" in document:
        transform = document["transform"]
        if not isinstance(transform, dict):
            raise DataError(f'{path}: "transform" must be an object')
        scale = point_array(f'{path}: "transform.scale"', [transform.get("scale")], (3,))
        translate = point_array(f'{path}: "transform.translate"', [transform.get("translate")], (3,))
        if (scale <= 0.0).any():
            raise DataError(f'{path}: "transform.scale" = {scale[0].tolist()}, must be > 0')
        with np.errstate(over="ignore"):
            vertices = vertices * scale + translate
    if (np.abs(vertices) > 1e9).any():
        raise DataError(f"{path}: a vertex lies more than 1e9 m from zero; coordinates must be metric")
    return vertices


def _stands_for_parts(where: str, item: dict[str, Any], objects: dict[str, Any]) -> bool:
    """Whether a building has no body of its own because its parts have it.

    A footprint (LoD0) is no body; models of whole countries have it at the building, the rest at its parts.
    """
    children = item.get("children")
    geometries = item.get("geometry", [])
    if not children or not isinstance(children, list) or not isinstance(geometries, list):
        return False
    if any(not isinstance(each, dict) or _lod(where, each) >= 1.0 for each in geometries):
        return False
    found = [objects.get(child) if isinstance(child, str) else None for child in children]
    for child, part in zip(children, found, strict=True):
        if not isinstance(part, dict):
            raise DataError(
                f"{where}: has no geometry of LoD1 or more, and its part {shown(child)} is not there"
            )
    if not any(part.get("type") == "BuildingPart" for part in found if part is not None):
        raise DataError(
            f"{where}: has no geometry of LoD1 or more, and none of its children is a BuildingPart; only "
            "objects of type Building and BuildingPart are read"
        )
    return True


def _building_surfaces(where: str, item: dict[str, Any]) -> list[list[NDArray[np.int64]]]:
    """Faces of a building's block model, each a list of rings of vertex indices."""
    geometries = item.get("geometry")
    if not isinstance(geometries, list) or not all(isinstance(each, dict) for each in geometries):
        raise DataError(f'{where}: "geometry" must be a list of objects')
    by_lod = [(_lod(where, geometry), geometry) for geometry in geometries]
    solid = [(lod, geometry) for lod, geometry in by_lod if lod >= 1.0]
    if not solid:
        raise DataError(f"{where}: has no geometry of LoD1 or more, so no height")
    geometry = min(solid, key=lambda each: each[0])[1]
    depth = _SURFACE_DEPTH.get(geometry["type"]) if isinstance(geometry.get("type"), str) else None
    if depth is None:
        raise DataError(
            f"{where}: geometry is {shown(geometry.get('type'))}, must be one of {', '.join(_SURFACE_DEPTH)}"
        )
    surfaces = list(_unnest(where, geometry.get("boundaries"), depth))
    if not surfaces:
        raise DataError(f"{where}: its boundaries are empty")
    faces = [[_ring_indices(where, ring) for ring in _unnest(where, each, 1)] for each in surfaces]
    if not all(faces):
        raise DataError(f"{where}: a face of its boundaries has no ring")
    return faces


def _lod(where: str, geometry: dict[str, Any]) -> float:
    if geometry.get("type") == "GeometryInstance":  # it has no lod, its template has
        raise DataError(
            f"{where}: geometry is a GeometryInstance, and templates are not read; write its surfaces out"
        )
    try:
        lod = float(str(geometry.get("lod")))
    except ValueError:
        lod = math.nan
    if not 0.0 <= lod < 10.0:
        raise DataError(f"{where}: lod = {shown(geometry.get('lod'))}, must be a number such as 1 or 1.2")
    return lod


def _unnest(where: str, boundaries: Any, depth: int) -> Iterator[Any]:
    if not isinstance(boundaries, list):
        raise DataError(f"{where}: its boundaries are not nested as its type asks")
    if depth == 1:
        yield from boundaries
    else:
        for each in boundaries:
            yield from _unnest(where, each, depth - 1)


def _ring_indices(where: str, ring: Any) -> NDArray[np.int64]:
    if not isinstance(ring, list) or len(ring) < 3 or not all(type(i) is int for i in ring):
        raise DataError(f"{where}: a ring of its boundaries must be a list of at least 3 vertex indices")
    if not all(0 <= i < 2**31 for i in ring):
        raise DataError(f"{where}: a boundary names a vertex below zero or beyond any file")
    return np.array(ring, dtype=np.int64)


def _seen_from_above(plane: Array, faces: list[list[NDArray[np.int64]]]) -> shapely.Geometry:
    """Union of the faces projected onto the ground; walls have no area there and vanish."""
    shadows = [shapely.Polygon(plane[rings[0]], [plane[ring] for ring in rings[1:]]) for rings in faces]
    return shapely.union_all([part for shadow in shadows for part in polygons_of(shapely.make_valid(shadow))])
