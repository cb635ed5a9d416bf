import copy
import gzip
import json
import math
import random
import time

import numpy as np
import pytest
import shapely

from napf_mpc.errors import DataError
from napf_mpc.formation import PathFrame
from napf_mpc.problem import City
from napf_mpc.world import buildings
from napf_mpc.world.city import load_city, read_cityjson, read_geojson
from napf_mpc.world.scenes import build_scenes

LATITUDE, LONGITUDE = 35.69, 139.69
TOKYO = "city_tokyo_nishi_shinjuku/buildings.geojson"
DELFT = "city_delft_cityjson/delft.city.json"


def metres_per_degree(latitude_deg):
    """Length of a degree of longitude and of latitude, from the radii of curvature of WGS-84."""
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    w = 1 - e2 * math.sin(math.radians(latitude_deg)) ** 2
    east = math.radians(a / math.sqrt(w) * math.cos(math.radians(latitude_deg)))
    return east, math.radians(a * (1 - e2) / w**1.5)


def degrees(*corners):
    """Ring in degrees, closed, from metres east and north of the test origin."""
    east, north = metres_per_degree(LATITUDE)
    return [[LONGITUDE + x / east, LATITUDE + y / north] for x, y in (*corners, corners[0])]


def rectangle(x0, y0, x1, y1):
    return degrees((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def feature(name, height, geometry, coordinates):
    return {
        "type": "Feature",
        "properties": {"id": name, "height_m": height},
        "geometry": {"type": geometry, "coordinates": coordinates},
    }


def small_town():
    """A plain house, one with a courtyard, one in two parts and a bow-tie, all near the test origin."""
    return {
        "type": "FeatureCollection",
        "features": [
            feature("plain", 12.5, "Polygon", [rectangle(0, 0, 10, 20)]),
            feature("court", 30, "Polygon", [rectangle(50, 0, 90, 40), rectangle(60, 10, 80, 30)]),
            feature(
                "parts",
                8.0,
                "MultiPolygon",
                [[rectangle(-30, 0, -20, 10)], [rectangle(-60, 0, -40, 10), rectangle(-55, 2, -45, 8)]],
            ),
            feature("tie", 5.0, "Polygon", [degrees((0, 50), (10, 60), (10, 50), (0, 60))]),
        ],
    }


def cube_town():
    """A block with a courtyard as a shell without floor, a building with a part, and a road."""
    plan = [(0, 0), (30, 0), (30, 20), (0, 20), (10, 5), (20, 5), (20, 15), (10, 15)]
    vertices = [[1000 * x, 1000 * y, z] for z in (500, 12500) for x, y in plan]
    vertices += [
        [1000 * x, 1000 * y, z] for z in (0, 9000) for x, y in ((50, 0), (60, 0), (60, 10), (50, 10))
    ]
    roof = [[8, 9, 12], [9, 13, 12], [9, 10, 13], [10, 14, 13]]
    roof += [[10, 11, 14], [11, 15, 14], [11, 8, 15], [8, 12, 15]]
    walls = [[0, 1, 9, 8], [1, 2, 10, 9], [2, 3, 11, 10], [3, 0, 8, 11], [4, 12, 13, 5], [5, 13, 14, 6]]
    box = [[16, 17, 18, 19], [20, 21, 22, 23], [16, 17, 21, 20], [17, 18, 22, 21], [18, 19, 23, 22]]
    return {
        "type": "CityJSON",
        "version": "2.0",
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"},
        "transform": {"scale": [0.001, 0.001, 0.001], "translate": [84000.0, 447000.0, 2.0]},
        "vertices": vertices,
        "CityObjects": {
            "court": {
                "type": "Building",
                "geometry": [
                    {"type": "MultiSurface", "lod": "0", "boundaries": [[[0, 1, 2, 3]]]},
                    {"type": "Solid", "lod": "1.2", "boundaries": [[[face] for face in roof + walls]]},
                ],
            },
            "whole": {"type": "Building", "children": ["part"]},
            "part": {
                "type": "BuildingPart",
                "parents": ["whole"],
                "geometry": [
                    {"type": "MultiSurface", "lod": "2.1", "boundaries": [[[0, 1, 2]], [[8, 9, 10]]]},
                    {"type": "MultiSurface", "lod": 1, "boundaries": [[face] for face in box]},
                ],
            },
            "street": {
                "type": "Road",
                "geometry": [{"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, 17]]]}],
            },
        },
    }


def court_object(town):
    return town["CityObjects"]["court"]


def court(town):
    """The geometry of the courtyard block that a reader takes."""
    return court_object(town)["geometry"][1]


def write(folder, document, name="town.geojson"):
    path = folder / name
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def footprint(prism):
    """Footprint by shapely's own even-odd union, independent of how rings are ordered."""
    area = shapely.Polygon()
    for ring in prism.rings:
        area = area.symmetric_difference(shapely.Polygon(ring))
    return area


# --------------------------------------------------------------------------------------------- GeoJSON


def test_small_town_becomes_prisms_in_metres(tmp_path):
    town = read_geojson(write(tmp_path, small_town()), origin_deg=(LATITUDE, LONGITUDE))
    assert town.origin == (LATITUDE, LONGITUDE)
    assert [name.split("'")[1] for name in town.names] == ["plain", "court", "parts", "parts", "tie", "tie"]
    assert [prism.top_m for prism in town.prisms] == [12.5, 30.0, 8.0, 8.0, 5.0, 5.0]
    assert all(prism.base_m == 0.0 for prism in town.prisms)
    areas = [footprint(prism).area for prism in town.prisms]
    assert areas == pytest.approx([200.0, 1200.0, 100.0, 140.0, 25.0, 25.0], rel=1e-4)
    # The ellipsoid's radii of curvature place the corners within a millimetre at 100 m.
    expected = shapely.box(50, 0, 90, 40) - shapely.box(60, 10, 80, 30)
    assert footprint(town.prisms[1]).hausdorff_distance(expected) < 2e-3


def test_courtyards_and_bow_ties_keep_their_inside_and_outside(tmp_path):
    write(tmp_path, small_town())
    world = City(
        kind="city", file="town.geojson", origin_latitude_deg=LATITUDE, origin_longitude_deg=LONGITUDE
    )
    obstacles = load_city(world, tmp_path)
    points = [
        (5, 10, 6.25),  # in the plain house: 5 m to its long walls
        (70, 20, 5),  # in the courtyard: free, 10 m to its walls
        (55, 20, 15),  # in the wall around it
        (-50, 5, 4),  # in the courtyard of the second part: 3 m
        (5, 51, 2.5),  # under the tie's knot: free
        (1, 55, 2.5),  # in its left half
        (5, 10, 22.5),  # 10 m above the plain house
    ]
    distance = obstacles.signed_distance(np.array([points], dtype=float))[0]
    assert distance == pytest.approx([-5, 10, -5, 3, 4 / math.sqrt(2), -1, 10], abs=5e-3)


def test_default_origin_is_the_middle_whatever_is_filtered(tmp_path):
    path = write(tmp_path, small_town())
    town, tall = read_geojson(path), read_geojson(path, min_height_m=10.0)
    assert town.origin == tall.origin
    east, north = metres_per_degree(LATITUDE)
    assert (town.origin[1] - LONGITUDE) * east == pytest.approx(15.0, abs=1e-2)
    assert (town.origin[0] - LATITUDE) * north == pytest.approx(30.0, abs=1e-2)
    assert len(tall.prisms) == 2


def test_default_origin_of_buildings_on_both_sides_of_the_antimeridian(tmp_path):
    """Taveuni, Fiji: GeoJSON cuts there (RFC 7946, 3.1.9), and half of 180 and -180 is off Africa."""
    east, north = metres_per_degree(-16.8)
    width, depth = 30.0 / east, 20.0 / north

    def house(west, height):
        ring = [[west, -16.8], [west + width, -16.8], [west + width, -16.8 + depth], [west, -16.8 + depth]]
        return feature("house", height, "Polygon", [[*ring, ring[0]]])

    document = {"type": "FeatureCollection", "features": [house(180.0 - width, 10.0), house(-180.0, 20.0)]}
    town = read_geojson(write(tmp_path, document))
    assert abs(town.origin[1]) == pytest.approx(180.0, abs=1e-9)
    assert [prism.top_m for prism in town.prisms] == [10.0, 20.0]
    bounds = [footprint(prism).bounds for prism in town.prisms]
    assert bounds[0] == pytest.approx((-30.0, -10.0, 0.0, 10.0), abs=0.05)
    assert bounds[1] == pytest.approx((0.0, -10.0, 30.0, 10.0), abs=0.05)


def test_buildings_behind_the_earth_are_counted_as_read(tmp_path):
    path = write(tmp_path, small_town())
    with pytest.raises(DataError, match=r"none of its buildings is left: 5 were read, .*origin \(-34, -41\)"):
        read_geojson(path, origin_deg=(-34.0, -41.0))


def test_filters(tmp_path):
    path = write(tmp_path, small_town())
    here = {"origin_deg": (LATITUDE, LONGITUDE)}
    assert {prism.top_m for prism in read_geojson(path, min_height_m=8.0, **here).prisms} == {8.0, 12.5, 30.0}
    # A building counts by its nearest point: 20 m to the nearer part, 40 m to the other.
    assert [prism.top_m for prism in read_geojson(path, radius_m=30.0, **here).prisms] == [12.5, 8.0]
    with pytest.raises(DataError, match=r"none of its buildings is left: 5 were read.*min_height_m = 31"):
        read_geojson(path, min_height_m=31.0, **here)
    # Straight through the earth is not near: the plane alone would put the town about the origin.
    with pytest.raises(DataError, match="none of its buildings"):
        read_geojson(path, origin_deg=(-LATITUDE, LONGITUDE - 180.0), radius_m=1e5)


def test_footprints_without_area_are_dropped(tmp_path):
    town = small_town()
    town["features"].append(feature("line", 9.0, "Polygon", [degrees((0, 0), (5, 5), (10, 10))]))
    town["features"].append(feature("dot", 9.0, "Polygon", [degrees((1, 1), (1, 1), (1, 1))]))
    town["features"][0]["geometry"]["coordinates"].append(rectangle(5, 5, 5.01, 5.01))
    result = read_geojson(write(tmp_path, town))
    assert len(result.prisms) == 6
    assert len(result.prisms[0].rings) == 1


def test_height_property_can_be_named(tmp_path):
    town = {"type": "FeatureCollection", "features": [feature("a", 1.0, "Polygon", [rectangle(0, 0, 9, 9)])]}
    town["features"][0]["properties"]["storeys"] = 3
    assert read_geojson(write(tmp_path, town), height_property="storeys").prisms[0].top_m == 3.0
    with pytest.raises(DataError, match=r"town\.geojson.*feature 0 \(id 'a'\).*no property \"levels\""):
        read_geojson(write(tmp_path, town), height_property="levels")


@pytest.mark.parametrize("height", [0, -3.0, "12", None, True, 1e999, 10**400, [4.0]], ids=repr)
def test_unusable_heights_are_named(tmp_path, height):
    town = small_town()
    town["features"][1]["properties"]["height_m"] = height
    with pytest.raises(DataError, match=r"town\.geojson: feature 1 \(id 'court'\).*height_m"):
        read_geojson(write(tmp_path, json.dumps(town).replace("Infinity", "1e999")))


@pytest.mark.parametrize(
    ("geometry", "named"),
    [
        (None, "geometry is None"),
        ({"type": "Point", "coordinates": [139.0, 35.0]}, "geometry is 'Point'"),
        ({"type": "Polygon", "coordinates": []}, "list of rings"),
        ({"type": "Polygon"}, "list of rings"),
        ({"type": "MultiPolygon", "coordinates": []}, "no coordinates"),
        ({"type": "Polygon", "coordinates": [[[139.0, 35.0]] * 3]}, "has 3 positions"),
        ({"type": "Polygon", "coordinates": [[["139", "35"]] * 4]}, "list of positions"),
        ({"type": "Polygon", "coordinates": [[[139.0, 35.0], [1.0]] * 2]}, "list of positions"),
        ({"type": "Polygon", "coordinates": [[[388000.0, 3950000.0]] * 4]}, "not longitude, latitude"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_unusable_geometries_are_named(tmp_path, geometry, named):
    town = small_town()
    town["features"][2]["geometry"] = geometry
    with pytest.raises(DataError, match=rf"feature 2 \(id 'parts'\).*{named}"):
        read_geojson(write(tmp_path, town))


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("urn:ogc:def:crs:OGC:1.3:CRS84", True),
        ("urn:ogc:def:crs:EPSG::6668", True),
        ("EPSG:4326", True),
        ("urn:ogc:def:crs:EPSG::6677", False),  # Japan's plane IX, metres about a point in Tokyo's region
        ("urn:ogc:def:crs:EPSG::25832", False),
        (7, False),
    ],
)
def test_a_crs_that_is_not_in_degrees_is_refused(tmp_path, name, read):
    town = small_town() | {"crs": {"type": "name", "properties": {"name": name}}}
    path = write(tmp_path, town)
    if read:
        assert read_geojson(path).names == read_geojson(write(tmp_path, small_town(), "b.geojson")).names
    else:
        with pytest.raises(DataError, match=r"town\.geojson: crs .* is not WGS-84"):
            read_geojson(path)


# -------------------------------------------------------------------------------------------- CityJSON


def test_blocks_are_recovered_from_their_faces(tmp_path):
    town = read_cityjson(write(tmp_path, cube_town(), "town.json"))
    assert town.names == ("building 'court'", "building 'part'")
    # By default the middle of the buildings, and their lowest base as ground.
    assert town.origin == pytest.approx((84030.0, 447010.0, 2.0))
    court, part = town.prisms
    assert (court.base_m, court.top_m) == pytest.approx((0.5, 12.5))
    assert (part.base_m, part.top_m) == pytest.approx((0.0, 9.0))
    expected = shapely.box(-30, -10, 0, 10) - shapely.box(-20, -5, -10, 5)
    assert footprint(court).symmetric_difference(expected).area < 1e-6
    assert footprint(part).symmetric_difference(shapely.box(20, -10, 30, 0)).area < 1e-6


def test_a_roof_may_be_one_face_with_a_hole(tmp_path):
    town = cube_town()
    court(town).update(type="MultiSurface", boundaries=[[[8, 9, 10, 11], [12, 13, 14, 15]], [[0, 1, 9, 8]]])
    prism = read_cityjson(write(tmp_path, town, "town.json")).prisms[0]
    assert len(prism.rings) == 2
    assert footprint(prism).area == pytest.approx(500.0)


def test_origin_in_the_files_coordinates(tmp_path):
    path = write(tmp_path, cube_town(), "town.json")
    moved = read_cityjson(path, origin_m=(84000.0, 447000.0, 0.0), min_height_m=10.0)
    assert moved.names == ("building 'court'",)
    assert (moved.prisms[0].base_m, moved.prisms[0].top_m) == pytest.approx((2.5, 14.5))
    assert footprint(moved.prisms[0]).bounds == pytest.approx((0, 0, 30, 20))
    near = read_cityjson(path, origin_m=(84070.0, 447005.0, 0.0), radius_m=11.0)
    assert near.names == ("building 'part'",)


def test_old_files_without_transform_and_solids_of_solids(tmp_path):
    town = cube_town()
    scale = town.pop("transform")["scale"][0]
    town["vertices"] = [[scale * value for value in vertex] for vertex in town["vertices"]]
    town["version"] = "1.0"
    geometry = court(town)
    geometry.update(type="MultiSolid", boundaries=[geometry["boundaries"]])
    result = read_cityjson(write(tmp_path, town, "town.json"))
    assert footprint(result.prisms[0]).area == pytest.approx(500.0)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda town: town.update(type="FeatureCollection"), "not a CityJSON"),
        (lambda town: town.update(CityObjects=[]), '"CityObjects" must be'),
        (lambda town: town.update(CityObjects={}), "no object of type Building"),
        (lambda town: town.update(vertices=[]), '"vertices" must be'),
        (lambda town: town["vertices"].append([1, 2]), '"vertices" must be'),
        (lambda town: town["vertices"].append([1, 2, 1e308]), "1e9 m"),
        (lambda town: town["transform"].update(scale=[1, 0, 1]), r"transform\.scale"),
        (lambda town: town["transform"].update(translate=None), r"transform\.translate"),
        (lambda town: town.update(transform=[]), '"transform" must be'),
        (
            lambda town: town["metadata"].update(referenceSystem="urn:ogc:def:crs:EPSG::4326"),
            "is geographic",
        ),
        (lambda town: court_object(town).pop("type"), "court.*no \"type\""),
        (lambda town: court_object(town).pop("geometry"), "court.*geometry"),
        (lambda town: court_object(town)["geometry"].pop(), "court.*LoD1"),
        (lambda town: court(town).update(lod="x"), "court.*lod"),
        (lambda town: court(town).update(type="Cube"), "court.*'Cube'"),
        (
            lambda town: court_object(town)["geometry"].append({"type": "GeometryInstance", "template": 0}),
            "court.*GeometryInstance, and templates are not read",
        ),
        (lambda town: court(town).update(boundaries=[]), "court.*empty"),
        (lambda town: court(town).update(boundaries=[[[]]]), "court.*no ring"),
        (
            lambda town: court(town).update(boundaries=[[[[0, 1, 99]]]]),
            "court.*vertex 99 of 24",
        ),
        (
            lambda town: court(town).update(boundaries=[[[[0, 1, -1]]]]),
            "court.*below zero",
        ),
        (
            lambda town: court(town).update(boundaries=[[[[0, 1, 2, 3]]]]),
            "court.*no height",
        ),
        (
            lambda town: court(town).update(boundaries=[[[[0, 1, 9, 8]]]]),
            "court.*no floor and no roof",
        ),
    ],
)  # fmt: skip
def test_faults_of_a_cityjson_file_are_named(tmp_path, change, named):
    town = cube_town()
    change(town)
    with pytest.raises(DataError, match=rf"town\.json.*{named}"):
        read_cityjson(write(tmp_path, town, "town.json"))


@pytest.mark.parametrize(
    "system",
    [
        "https://www.opengis.net/def/crs/EPSG/0/2263",  # New York Long Island (ftUS)
        "urn:ogc:def:crs:EPSG::2222",  # Arizona East (ft)
        "urn:ogc:def:crs:EPSG:9.8:6539",  # New York Long Island (ftUS) of 2011
        "EPSG:26918+6360",  # UTM in metres, heights in feet
        "urn:ogc:def:crs,crs:EPSG::2263,crs:EPSG::5703",  # the other way round
        "https://www.opengis.net/def/crs-compound?1=https://www.opengis.net/def/crs/EPSG/0/2263"
        "&2=https://www.opengis.net/def/crs/EPSG/0/6360",
        "NAD83 / New York Long Island (ftUS)",
    ],
)
def test_a_cityjson_file_in_feet_is_refused(tmp_path, system):
    """Taken as metres, its buildings would be three times as wide and as high."""
    town = cube_town()
    town["metadata"] = {"referenceSystem": system}
    with pytest.raises(DataError, match=r"town\.json: referenceSystem .* is in feet; .* metric: convert"):
        read_cityjson(write(tmp_path, town, "town.json"))


@pytest.mark.parametrize(
    "system",
    [
        "https://www.opengis.net/def/crs/EPSG/0/7415",
        "urn:ogc:def:crs:EPSG::28992",
        "EPSG:26918+5703",
        "https://www.opengis.net/def/crs/EPSG/2263/7415",  # a version is no code
        "https://example.org/crs/2263",  # of another register
        "EPSG:" + "9" * 5000,
        "",
        None,
    ],
)
def test_a_cityjson_file_in_metres_or_of_unknown_unit_is_read(tmp_path, system):
    town = cube_town()
    town["metadata"] = {"referenceSystem": system}
    assert len(read_cityjson(write(tmp_path, town, "town.json")).prisms) == 2


def national_town():
    """As models of whole countries are made: the footprint at the building, bodies at its part."""
    town = cube_town()
    court_object(town).update(geometry=court_object(town)["geometry"][:1], children=["court-0"])
    town["CityObjects"]["court-0"] = {
        "type": "BuildingPart",
        "parents": ["court"],
        "geometry": cube_town()["CityObjects"]["court"]["geometry"][1:],
    }
    return town


def test_a_building_with_a_footprint_alone_is_read_by_its_parts(tmp_path):
    found = read_cityjson(write(tmp_path, national_town(), "town.json"))
    plain = read_cityjson(write(tmp_path, cube_town(), "town.json"))
    assert sorted(found.names) == ["building 'court-0'", "building 'part'"]
    assert sorted(footprint(prism).area for prism in found.prisms) == sorted(
        footprint(prism).area for prism in plain.prisms
    )
    assert found.origin == plain.origin


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda town: town["CityObjects"].pop("court-0"), "court.*its part 'court-0' is not there"),
        (lambda town: town["CityObjects"].pop("part"), "whole.*its part 'part' is not there"),
        (
            lambda town: town["CityObjects"]["court-0"].update(type="BuildingStorey"),
            "court.*none .* BuildingPart",
        ),
        (lambda town: court_object(town).update(children=[]), "court.*no geometry of LoD1"),
        (lambda town: court_object(town).update(children=[{}]), "court.*part {} is not there"),
    ],
)
def test_no_building_is_left_out_because_its_parts_are_missing(tmp_path, change, named):
    town = national_town()
    change(town)
    with pytest.raises(DataError, match=rf"town\.json.*{named}"):
        read_cityjson(write(tmp_path, town, "town.json"))


def test_degrees_are_refused_whatever_the_system_is_called(tmp_path):
    """EPSG:6697 is that of Japan's city models: latitude, longitude, height."""
    town = cube_town()
    town["metadata"] = {"referenceSystem": "http://www.opengis.net/def/crs/EPSG/0/6697"}
    town["transform"] = {"scale": [1e-8, 1e-8, 0.001], "translate": [35.69, 139.69, 2.0]}
    with pytest.raises(
        DataError, match=r"town\.json: its widest building measures 0\.0003, as in degrees; .*convert"
    ):
        read_cityjson(write(tmp_path, town, "town.json"))


def test_whole_numbers_are_no_metres_since_version_1_1(tmp_path):
    for version in ("1.1", "2.0"):
        town = cube_town()
        town["version"] = version
        town.pop("transform")
        with pytest.raises(DataError, match=rf"town\.json: version '{version}' needs \"transform\""):
            read_cityjson(write(tmp_path, town, "town.json"))


@pytest.mark.parametrize("zone_m", [(32_691_000.0, 5_334_000.0, 515.0), (2_683_000.0, 1_247_000.0, 400.0)])
def test_a_problem_may_lie_in_any_projected_system(tmp_path, zone_m):
    """Munich with the zone before its easting, and Zurich: both beyond a million metres."""
    town = cube_town()
    town["transform"]["translate"] = list(zone_m)
    write(tmp_path, town, "town.json")
    world = City.model_validate({"kind": "city", "file": "town.json", "origin_m": zone_m})
    found = load_city(world, tmp_path)
    assert found.scene_start.tolist() == [0, 2]


# ------------------------------------------------------------------------------------------ both files


READERS = pytest.mark.parametrize(
    ("read", "make"), [(read_geojson, small_town), (read_cityjson, cube_town)], ids=["geojson", "cityjson"]
)


@READERS
def test_text_that_is_no_city_is_a_data_error(tmp_path, read, make):
    whole = json.dumps(make())
    for text in ("", "{", "[]", "null", "3", whole[:-20], "[" * 100_000, '{"id": 1' + "0" * 5000 + "}"):
        with pytest.raises(DataError, match="town"):
            read(write(tmp_path, text))
    for word in ("NaN", "Infinity", "-Infinity"):
        with pytest.raises(DataError, match=f"is not JSON: {word} is not a number"):
            read(write(tmp_path, whole[:-1] + f', "note": {word}}}'))
    (tmp_path / "town.geojson").write_bytes(b"\xff\xfe\x00{}")
    with pytest.raises(DataError, match="is not JSON"):
        read(tmp_path / "town.geojson")
    with pytest.raises(DataError, match=r"missing\.json: cannot be read: no such file"):
        read(tmp_path / "missing.json")
    with pytest.raises(DataError, match="cannot be read: is a folder; name a file in it"):
        read(tmp_path)
    (tmp_path / "town.json.gz").write_bytes(gzip.compress(whole.encode()))
    with pytest.raises(DataError, match=r"town\.json\.gz: is packed by gzip; unpack it first"):
        read(tmp_path / "town.json.gz")


@READERS
def test_a_byte_order_mark_and_a_name_as_text_are_read(tmp_path, read, make):
    path = tmp_path / "town.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(make()).encode())
    assert read(str(path)).names == read(write(tmp_path, make())).names


@pytest.mark.parametrize(
    ("read", "make", "name", "words"),
    [
        (read_cityjson, cube_town, "origin_m", "3 finite numbers: x, y, z"),
        (read_geojson, small_town, "origin_deg", "2 finite numbers: latitude, longitude"),
    ],
)
def test_an_origin_is_so_many_numbers(tmp_path, read, make, name, words):
    path = write(tmp_path, make(), "town.json")
    for origin in ((0.0,), (0.0, 0.0, 0.0, 0.0), (0.0, math.nan), (0.0, 0.0, math.nan), ("a", "b", "c"), 0.0):
        with pytest.raises(DataError, match=rf"town\.json: {name} = .*, must be {words}"):
            read(path, **{name: origin})
    other = (0.0, 0.0) if name == "origin_m" else (0.0, 0.0, 0.0)
    with pytest.raises(DataError, match=rf"{name} = .*, must be {words}"):
        read(path, **{name: other})


def leaves(node, path=()):
    """Paths of every value in a document."""
    yield path
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield from leaves(value, (*path, key))


@READERS
def test_mutated_files_are_read_or_refused_but_never_break(tmp_path, read, make):
    dice = random.Random(20)
    paths = [path for path in leaves(make()) if path]
    values = [math.nan, math.inf, -1, 0, 1e308, 10**30, "x", None, True, [], {}, [[]], [None], -1e-300]
    refused = 0
    for number in range(1000):
        town = copy.deepcopy(make())
        path = paths[number % len(paths)] if number < len(paths) else dice.choice(paths)
        holder = town
        for key in path[:-1]:
            holder = holder[key]
        if dice.random() < 0.1:
            del holder[path[-1]]
        else:
            holder[path[-1]] = dice.choice(values)
        try:
            result = read(write(tmp_path, town))
        except DataError:
            refused += 1
            continue
        assert all(np.isfinite(ring).all() for prism in result.prisms for ring in prism.rings)
        assert all(math.isfinite(prism.base_m) and math.isfinite(prism.top_m) for prism in result.prisms)
    assert 300 < refused < 1000


def test_large_files_are_refused(tmp_path, monkeypatch):
    path = write(tmp_path, small_town())
    monkeypatch.setattr(buildings, "MAX_FILE_BYTES", 1000)
    with pytest.raises(DataError, match="at most 1000 are read"):
        read_geojson(path)


def test_a_city_is_read_once_until_it_changes(tmp_path):
    path = write(tmp_path, small_town())
    world = City(kind="city", file="town.geojson")
    first = load_city(world, tmp_path)
    assert load_city(world, tmp_path) is first
    town = small_town()
    del town["features"][0]
    path.write_text(json.dumps(town))
    assert len(load_city(world, tmp_path)) == len(first) - 1


def test_the_ending_decides_and_settings_must_fit(tmp_path):
    write(tmp_path, cube_town(), "town.city.json")
    write(tmp_path, small_town())
    write(tmp_path, small_town(), "town.txt")
    assert len(load_city(City(kind="city", file="town.city.json"), tmp_path)) == 2
    with pytest.raises(DataError, match=r"must end in \.geojson"):
        load_city(City(kind="city", file="town.txt"), tmp_path)
    with pytest.raises(DataError, match="origin_m is for CityJSON"):
        load_city(City(kind="city", file="town.geojson", origin_m=(0.0, 0.0, 0.0)), tmp_path)
    degrees_given = {"origin_latitude_deg": 35.0, "origin_longitude_deg": 139.0}
    with pytest.raises(DataError, match="origin_latitude_deg is for GeoJSON"):
        load_city(City(kind="city", file="town.city.json", **degrees_given), tmp_path)
    with pytest.raises(DataError, match="nowhere"):
        load_city(City(kind="city", file="nowhere.geojson"), tmp_path)


def test_city_is_one_scene_for_all_runs(tmp_path):
    write(tmp_path, small_town())
    frame = PathFrame.from_angles((0.0, 0.0, 0.0), 0.5, 0.0)
    world = City(kind="city", file="town.geojson")
    obstacles = build_scenes(world, frame, np.zeros(1), 3, range(10), tmp_path)
    assert (obstacles.n_scenes, len(obstacles)) == (1, 6)


# ------------------------------------------------------------------------------------------- real files


def test_tokyo(data_folder):
    start = time.perf_counter()
    city = read_geojson(data_folder / TOKYO, origin_deg=(35.6895, 139.6917))
    assert time.perf_counter() - start < 10.0
    assert len(city.prisms) == 3491
    assert sum(len(prism.rings) > 1 for prism in city.prisms) == 51
    heights = np.array([prism.top_m for prism in city.prisms])
    assert heights.min() == pytest.approx(2.0, abs=0.5)
    assert heights.max() == pytest.approx(262.0, abs=0.5)
    assert np.median(heights) == pytest.approx(11.3, abs=0.05)
    assert np.quantile(heights, 0.95) == pytest.approx(45.7, abs=0.1)
    assert (np.sum(heights > 50), np.sum(heights > 100)) == (131, 48)
    # The tallest is the city hall: the origin, given to 4 digits, lies in or next to it.
    tallest = footprint(city.prisms[int(heights.argmax())])
    assert tallest.distance(shapely.Point(0.0, 0.0)) < 30.0
    corners = np.concatenate([ring for prism in city.prisms for ring in prism.rings])
    assert np.ptp(corners, axis=0) == pytest.approx([1510.0, 1500.0], abs=10.0)
    built = shapely.union_all([footprint(prism) for prism in city.prisms])
    assert built.area / np.prod(np.ptp(corners, axis=0)) == pytest.approx(0.39, abs=0.01)


def test_tokyo_above_the_roofs(data_folder):
    world = City(
        kind="city",
        file=TOKYO,
        origin_latitude_deg=35.6895,
        origin_longitude_deg=139.6917,
        min_height_m=45.0,
        radius_m=600.0,
    )
    towers = load_city(world, data_folder)
    assert 20 < len(towers) < 200
    assert min(shape.top_m for shape in towers.shapes(0)) >= 45.0
    everything = load_city(world.model_copy(update={"min_height_m": 0.0, "radius_m": 5000.0}), data_folder)
    grid = np.stack(np.meshgrid(np.linspace(-300, 300, 25), np.linspace(-300, 300, 25)), -1).reshape(1, -1, 2)
    at_60 = np.concatenate([grid, np.full((*grid.shape[:2], 1), 60.0)], axis=-1)
    # At 60 m the low houses are at least 15 m below: towers alone decide whatever is nearer than that.
    near = everything.signed_distance(at_60) < 14.0
    assert near.any()
    assert towers.signed_distance(at_60)[near] == pytest.approx(everything.signed_distance(at_60)[near])


def test_delft(data_folder):
    city = read_cityjson(data_folder / DELFT)
    assert len(city.prisms) == len(set(city.names)) == 160
    assert min(prism.base_m for prism in city.prisms) == 0.0
    assert 5.0 < max(prism.top_m for prism in city.prisms) < 16.9 + 0.5
    corners = np.concatenate([ring for prism in city.prisms for ring in prism.rings])
    assert np.all(np.ptp(corners, axis=0) < [524.4, 327.7])
    # Independently: the upward faces of each shell, summed as signed areas, are its footprint.
    document = json.loads((data_folder / DELFT).read_text())
    vertices = np.array(document["vertices"]) * document["transform"]["scale"]
    objects = document["CityObjects"]
    for name, prism in zip(city.names, city.prisms, strict=True):
        shell = objects[name.split("'")[1]]["geometry"][0]["boundaries"][0]
        triangles = vertices[np.array([face[0] for face in shell])]
        a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        up = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        assert footprint(prism).area == pytest.approx(np.maximum(up, 0.0).sum(), rel=1e-6)
        assert prism.top_m - prism.base_m == pytest.approx(np.ptp(triangles[..., 2]), abs=1e-9)
