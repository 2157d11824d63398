"""Routes of plans, maps, tables and logs contain the same points."""

import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.flight import route_files as route
from aerpaw_cmp.flight.route_files import COLUMNS, read_route
from tests.parsers import samples

HOME = (35.7275, -78.6962, 90.0)
POINTS = ((35.7275, -78.6962, 40.0), (35.7285, -78.6962, 40.0), (35.7285, -78.6950, 55.0))


def item(command: int, *numbers: float | None, frame: int = 3) -> dict[str, object]:
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": list(numbers), "autoContinue": True}


def plan(*items: object, firmware: int = 12) -> bytes:
    mission = {"plannedHomePosition": HOME, "items": items, "firmwareType": firmware, "cruiseSpeed": 15}
    return json.dumps(
        {"fileType": "Plan", "version": 1, "mission": mission, "geoFence": {}, "rallyPoints": {}}
    ).encode()


def waypoint(place: tuple[float, float, float], *, yaw: float | None = None, frame: int = 3) -> dict[str, object]:
    return item(16, 0, 0, 0, yaw, *place, frame=frame)


def kml(shape: str) -> bytes:
    return f'<?xml version="1.0"?>\n<kml><Document><Placemark>{shape}</Placemark></Document></kml>\n'.encode()


def kmz(shape: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("files/icon.png", b"no picture")
        archive.writestr("doc.kml", kml(shape))
    return file.getvalue()


LINE = " ".join(f"{lon},{lat},{height}" for lat, lon, height in POINTS)
ABOVE = " ".join(f"{lon},{lat},{height + 90}" for lat, lon, height in POINTS)
TRACK = "".join(f"<gx:coord>{lon} {lat} {height}</gx:coord>" for lat, lon, height in POINTS)
WPL = "\n".join(
    f"{i}\t0\t{0 if i < 3 else 3}\t16\t0\t0\t0\t77\t{lat}\t{lon}\t{height + (90 if i < 3 else 0)}\t1"
    for i, (lat, lon, height) in enumerate(POINTS, start=1)
)
FILES = {
    "relative.plan": plan(*map(waypoint, POINTS)),
    "sea_level.plan": plan(*(waypoint((lat, lon, height + 90), frame=0) for lat, lon, height in POINTS)),
    "survey.plan": plan(
        waypoint(POINTS[0]),
        {"type": "ComplexItem", "complexItemType": "survey",
         "TransectStyleComplexItem": {"Items": [waypoint(POINTS[1]), waypoint(POINTS[2])]}},
    ),
    "here.plan": plan(item(22, 0, 0, 0, None, 0, 0, 40.0), waypoint(POINTS[1]), waypoint(POINTS[2])),
    "mission.waypoints": f"QGC WPL 110\r\n0\t1\t0\t16\t0\t0\t0\t0\t35.7275\t-78.6962\t90\t1\r\n{WPL}\r\n".encode(),
    "line.kml": kml("<LineString><altitudeMode>relativeToGround</altitudeMode><coordinates>\n" + LINE
                    + "\n</coordinates></LineString>"),
    "commas.kml": kml("<LineString><altitudeMode>relativeToGround</altitudeMode><coordinates>" + LINE.replace(" ", ",")
                      + "</coordinates></LineString>"),
    "signs.kml": kml("<LineString><altitudeMode>relativeToGround</altitudeMode><coordinates>"
                     + " ".join(f"{lon:+},{lat:+},{height:+}" for lat, lon, height in POINTS) + "</coordinates></LineString>"),
    "track.kml": kml(f"<gx:Track><altitudeMode>relativeToGround</altitudeMode>{TRACK}</gx:Track>"),
    "line.kmz": kmz("<LineString><altitudeMode>relativeToGround</altitudeMode><coordinates>" + LINE
                    + "</coordinates></LineString>"),
    "header.csv": b"Longitude,Latitude,Altitude (m)\r\n" + "".join(f"{b},{a},{c}\r\n" for a, b, c in POINTS).encode(),
    "feet.csv": b"lat;lng;alt [ft]\n" + "".join(f"{a};{b};{c / 0.3048}\n" for a, b, c in POINTS).encode(),
    "bare.csv": "".join(f"{a}, {b}, {c}\n" for a, b, c in POINTS).encode(),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_the_points_of_a_route(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(FILES[name])
    route = read_route(tmp_path / name)
    assert tuple(route.columns) == COLUMNS
    assert route[list(COLUMNS[:3])].to_numpy() == pytest.approx(np.array(POINTS), abs=1e-9)
    assert route["yaw_deg"].isna().all()  # said by nobody
    assert route["time_s"].isna().all()


def test_heights_above_sea_level_of_a_map_count_from_its_first_point_and_say_so(tmp_path: Path) -> None:
    file = tmp_path / "line.kml"
    file.write_bytes(
        kml(f"<LineString><altitudeMode>absolute</altitudeMode><coordinates>{ABOVE}</coordinates></LineString>")
    )
    route = read_route(file)
    assert route["altitude_m"].tolist() == pytest.approx([0.0, 0.0, 15.0])
    assert any("sea level" in text and "130.0 m" in text for text in route.attrs["remarks"])


@pytest.mark.parametrize(("home", "first"), [(HOME[:2], POINTS[0]), (HOME[:1], POINTS[1]), ((), POINTS[1])])
def test_a_take_off_without_coordinates_is_at_home_if_the_plan_has_one(home, first, tmp_path: Path) -> None:
    content = json.loads(FILES["here.plan"])
    content["mission"]["plannedHomePosition"] = home
    (tmp_path / "a.plan").write_text(json.dumps(content))
    assert read_route(tmp_path / "a.plan").iloc[0, :3].tolist() == pytest.approx(first)


REPORTED = Path(__file__).parents[1] / "reported"


@pytest.mark.parametrize("altitude", [0.0, None])
def test_heights_above_sea_level_want_the_homes_altitude(altitude: float | None, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="152 m above sea level, and a home position without an altitude"):
        read_route(REPORTED / "route_amsl_home0/homeless.waypoints")
    content = json.loads(plan(*(waypoint(place, frame=0) for place in POINTS)))
    content["mission"]["plannedHomePosition"][2] = altitude
    (tmp_path / "a.plan").write_text(json.dumps(content))
    with pytest.raises(InputError, match="above sea level, and a home position without an altitude"):
        read_route(tmp_path / "a.plan")
    content["mission"]["items"] = [waypoint(place) for place in POINTS]  # heights above home need none
    (tmp_path / "a.plan").write_text(json.dumps(content))
    assert len(read_route(tmp_path / "a.plan")) == 3


def test_a_line_at_one_height_above_sea_level_is_a_question(tmp_path: Path) -> None:
    flat = " ".join(f"{lon},{lat},152" for lat, lon, _ in POINTS)
    file = tmp_path / "a.kml"
    file.write_bytes(
        kml(f"<LineString><altitudeMode>absolute</altitudeMode><coordinates>{flat}</coordinates></LineString>")
    )
    with pytest.raises(InputError, match="the height of the take-off is unknown"):
        read_route(file)


def test_yaw_of_a_plan(tmp_path: Path) -> None:
    """A waypoint's own yaw counts on PX4 and not on ArduPilot, which turns by CONDITION_YAW."""
    file = tmp_path / "a.plan"
    file.write_bytes(plan(*(waypoint(place, yaw=45.0) for place in POINTS)))
    assert read_route(file)["yaw_deg"].tolist() == [45.0] * 3
    turned = item(115, 270, 30, 1, 0, None, None, None, frame=2)
    file.write_bytes(
        plan(waypoint(POINTS[0], yaw=45), waypoint(POINTS[1], yaw=45), turned, waypoint(POINTS[2]), firmware=3)
    )
    assert read_route(file)["yaw_deg"].tolist() == pytest.approx([np.nan, 270.0, np.nan], nan_ok=True)


def test_landings_returns_and_heights_above_ground(tmp_path: Path) -> None:
    file = tmp_path / "a.plan"
    above_ground = waypoint(POINTS[1], frame=10)
    file.write_bytes(
        plan(waypoint(POINTS[0]), above_ground, item(21, 0, 0, 0, None, 0, 0, 0), item(20, *[0] * 7, frame=2))
    )
    route = read_route(file)
    assert route["altitude_m"].tolist() == [40.0, 40.0, 0.0]
    assert route[["latitude_deg", "longitude_deg"]].iloc[2].tolist() == [*POINTS[1][:2]]
    assert [
        word for word in ("return", "above the ground") if any(word in text for text in route.attrs["remarks"])
    ] == ["return", "above the ground"]


def test_a_turn_before_the_first_point_and_points_on_the_equator(tmp_path: Path) -> None:
    file = tmp_path / "a.plan"
    points = waypoint((0.0, 20.0, 40.0)), waypoint((0.0, 20.001, 40.0))
    file.write_bytes(plan(item(115, 90, 0, 1, 0, 0, 0, 0), *points))
    assert read_route(file)["longitude_deg"].tolist() == [20.0, 20.001]


def test_a_table_with_its_own_yaw(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text(f"lat,lon,height_m,yaw_rad\n35.7,-78.7,30,{math.pi / 2}\n35.71,-78.7,30,-0.1\n")
    assert read_route(file)["yaw_deg"].tolist() == pytest.approx([90.0, 360 - math.degrees(0.1)])


@pytest.mark.parametrize(
    "text",
    [
        "lat;lon;altitude_m\n35,7275;-78,696;30,5\n",
        "35,7275;-78,696;30,5\n",
        "35.7275;-78.696;30.5\n",
        "lat\tlon\taltitude_m\n35,7275\t-78,696\t30,5\n",
        "sep=;\r\nlat;lon;altitude_m\r\n35,7275;-78,696;30,5\r\n",
        'lat,lon,altitude_m\n"35,7275","-78,696","30,5"\n',
    ],
)
def test_a_table_of_a_spreadsheet_may_have_decimal_commas(text: str, tmp_path: Path) -> None:
    (tmp_path / "route.csv").write_text(text)
    route = read_route(tmp_path / "route.csv")
    assert route[["latitude_deg", "longitude_deg", "altitude_m"]].to_numpy().tolist() == [[35.7275, -78.696, 30.5]]


def test_a_comma_between_thousands_is_not_a_decimal_comma(tmp_path: Path) -> None:
    (tmp_path / "route.csv").write_text("lat;lon;altitude_m\n35.7275;-78.696;1,300\n")
    with pytest.raises(InputError, match="'1,300'"):
        read_route(tmp_path / "route.csv")


def test_the_track_of_a_log_is_a_route_with_times(tmp_path: Path) -> None:
    file = tmp_path / "vehicleOut.txt"
    file.write_bytes(samples.FILES["vehicle_out/ten_fields"])
    route = read_route(file)
    assert route["time_s"].tolist() == [0.0, 2.0]  # the second record has no fix
    assert route["altitude_m"].tolist() == [0.5, 1.5]


def test_points_without_height_ask_for_one(tmp_path: Path) -> None:
    file = tmp_path / "a.kml"
    file.write_bytes(kml("<LineString><coordinates>-78.7,35.7,0 -78.7,35.8,0</coordinates></LineString>"))
    with pytest.raises(InputError, match="2 of 2 points without a height"):
        read_route(file)
    route = read_route(file, height_m=30.0)
    assert route["altitude_m"].tolist() == [30.0, 30.0]
    assert route.attrs["remarks"] == ["2 of 2 points without a height: 30 m is used."]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("fence.kml", kml("<Polygon><coordinates>-78.7,35.7,0</coordinates></Polygon>"), "geofence"),
        (
            "a.kml",
            kml("<LineString><coordinates>-78.7,35.7,-78.7,35.8</coordinates></LineString>"),
            "4 numbers separated only by commas",
        ),
        (
            "a.kml",
            kml("<LineString><coordinates>-78.7,35.7,-78.7,35.8,-78.6,35.8</coordinates></LineString>"),
            "6 numbers separated",
        ),
        ("a.plan", b'{"fileType": "Plan", "mission": 3}', "damaged QGroundControl plan"),
        ("a.plan", b'{"fileType": "Plan", "mission": {"items": [', "damaged QGroundControl plan"),
        ("a.plan", plan(), "no point"),
        ("a.plan", plan({"type": "ComplexItem", "complexItemType": "CorridorScan"}), "CorridorScan without its items"),
        ("a.waypoints", b"QGC WPL 110\n0 1 0\n", "line 2"),
        ("a.csv", b"name,place\nx,y\n", "no route"),
        ("a.csv", b"lon,lat\n35.7,-178.7\n", "point 1 lies at -178.7"),
        ("a.csv", b"lat,lon,altitude_amsl\n35.7,-78.7,120\n", "above sea level"),
        ("a.csv", b"lat,lon,alt\n35.7,-78.7,high\n", "row 2"),
        ("a.bin", b"\x00\x01\x02", "binary"),
    ],
)
def test_what_is_no_route_says_so(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_route(tmp_path / name)
    assert message in str(caught.value)
    assert caught.value.path == str(tmp_path / name)


def test_a_route_cut_off_is_refused_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "cut.kml"
    file.write_bytes(FILES["line.kml"][:-60])
    with pytest.raises(InputError, match=r"cut\.kml, line \d+: not XML"):
        read_route(file)


@pytest.mark.parametrize("form", ["csv", "csv without header", "wpl", "kml"])
def test_a_route_is_refused_when_its_limit_is_passed(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The row behind the limit is read, and none of the rows behind that one, which would each be an error."""
    monkeypatch.setattr(route, "MOST_POINTS", 3)
    rows = [f"{HOME[0]},{HOME[1]},40"] * 4 + ["x,y,z"]
    text = {
        "csv": "\n".join(["latitude,longitude,altitude", *rows]),
        "csv without header": "\n".join(rows),
        "wpl": "QGC WPL 110\n" + "".join(f"{i}\t0\t3\t16\t0\t0\t0\t0\t35.7\t-78.7\t40\t1\n" for i in range(6)),
        "kml": kml(f"<LineString><coordinates>{LINE} {LINE}</coordinates></LineString>").decode(),
    }[form]
    (tmp_path / "r").write_text(text)
    with pytest.raises(InputError, match="more than 3 points"):
        read_route(tmp_path / "r")


def test_a_large_file_that_is_no_log_is_refused_by_its_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (tmp_path / "sparse.csv").open("wb") as file:
        file.truncate(route.MOST_BYTES + 1)

    def never(*_: object) -> None:
        raise AssertionError("the file was read")

    monkeypatch.setattr(route, "read_bytes", never)
    with pytest.raises(InputError, match=r"the file has 268435457 bytes; expected at most 2000000 points"):
        read_route(tmp_path / "sparse.csv")
