"""Checked settings of a flight.yaml.

An unknown or duplicate key is an error, whose message names the nearest valid key. Relative paths resolve against the
file's folder, or ``--logs-root``. Overrides change single keys, which are written in dotted form, such as
``rt.max_depth`` or ``link.rss.tower.yaw_deg``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, PrivateAttr, ValidationError, field_validator, model_validator

from ..common.errors import UsageError
from ..common.files import inside
from ..common.outputs import check_seal
from ..common.units import SPEED_OF_LIGHT_MPS, FloatArray, carrier_fault, noise_floor_dbm, wavelength_m
from ..common.yamlfile import StrictModel, expectation, load_yaml, nearest, nearest_zone
from ..logs.readers import ReadOptions
from ..logs.records import Kind
from ..propagation import geometry
from ..propagation.options import Diffraction
from ..site.antennas import Isotropic
from ..site.learned import BAND, LearnedAntenna, Named, Written, check_band, read_pair, read_sphere_csv

Positive = Annotated[float, Field(gt=0)]


def _in_hertz(value: float) -> float:
    if fault := carrier_fault(value):
        raise ValueError(fault)
    return value


CarrierHz = Annotated[float, AfterValidator(_in_hertz)]


class AntennaSettings(StrictModel):
    """An element pattern: a named model, or a measured file.

    Parameters
    ----------
    variable : str, optional
        Name of the grid inside a .mat file.
    elevation : str, optional
        CSV of the elevation cut, if ``file`` contains the azimuth cut.
    learned : LearnedAntenna, optional
        SHA-256 and error model of the file, if the model is a learned ``sphere``.
    """

    model: Literal["iso", "dipole", "tr38901", "file", "gain_grid", "sphere"] = "iso"
    file: str | None = None
    variable: str | None = None
    elevation: str | None = None
    learned: LearnedAntenna | None = None

    @model_validator(mode="after")
    def _file_where_needed(self) -> AntennaSettings:
        if (self.file is None) != (self.model not in ("file", "gain_grid", "sphere")):
            raise ValueError("'file' belongs only to model 'file', 'gain_grid' or 'sphere'")
        if self.variable is not None and self.model != "gain_grid":
            raise ValueError("'variable' belongs to model 'gain_grid'")
        if self.elevation is not None and self.model != "file":
            raise ValueError("'elevation' belongs to model 'file', together with an azimuth cut")
        return self


class ArraySettings(StrictModel):
    """The antenna elements of one device.

    Layouts are ``single``, ``linear`` (``elements`` at half a wavelength, along the device's left axis) and ``custom``
    (``positions_m``). ``tower_comparison`` (60 mm / 1.68 m / 60 mm) and ``uav_comparison`` (2 x 2 at half a wavelength)
    are the arrays of arXiv 2502.10324. ``yaw_deg`` is counter-clockwise from east (tower) or from the aircraft's nose
    (UAV with logged attitude). Positive ``pitch_deg`` turns the boresight down.

    Parameters
    ----------
    elements : int, optional
        Number of elements of layout ``linear``. The default is 4.
    """

    layout: Literal["single", "linear", "tower_comparison", "uav_comparison", "custom"] = "single"
    elements: Annotated[int, Field(ge=1, le=64)] | None = None
    positions_m: Annotated[list[tuple[float, float, float]], Field(max_length=64)] | None = None
    antenna: AntennaSettings = AntennaSettings()
    slant_deg: float | list[float] = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    @model_validator(mode="after")
    def _of_its_layout(self) -> ArraySettings:
        for key, layout in (("elements", "linear"), ("positions_m", "custom")):
            if getattr(self, key) is not None and self.layout != layout:
                raise ValueError(f"'{key}' belongs to layout '{layout}', but the layout is '{self.layout}'")
        return self

    def positions(self, wavelength: float) -> FloatArray:
        """Return the element positions (elements, 3) in the device frame [m]."""
        if self.layout == "custom":
            if not self.positions_m:
                raise UsageError("layout 'custom' without 'positions_m'", expected="a list of [x, y, z] in metres")
            return np.asarray(self.positions_m, dtype=np.float64)
        if self.layout == "uav_comparison":
            return geometry.uav_comparison_array(wavelength).positions_m
        if self.layout == "tower_comparison":
            return geometry.tower_comparison_array().positions_m
        return geometry.linear_array(1 if self.layout == "single" else self.elements or 4, wavelength / 2).positions_m

    def build(self, wavelength: float, folder: Path) -> geometry.Array:
        """Return the array, with patterns loaded from files relative to ``folder``."""
        positions = self.positions(wavelength)
        # one slant for all elements, or one per element
        slant = np.atleast_1d(np.asarray(self.slant_deg, dtype=np.float64))
        if len(slant) not in (1, len(positions)):
            raise UsageError(
                f"{len(slant)} slants for {len(positions)} elements", expected="one slant, or one per element"
            )
        mount = geometry.rotation_from_yaw_pitch_roll(
            np.radians(self.yaw_deg), np.radians(self.pitch_deg), np.radians(self.roll_deg)
        )
        return geometry.Array(
            positions,
            np.radians(np.broadcast_to(slant, (len(positions),)).copy()),
            # one pattern for all elements; the carrier selects the frequency in a measured file
            (load_pattern(self.antenna, folder, SPEED_OF_LIGHT_MPS / wavelength),),
            mount,
        )


def load_pattern(settings: AntennaSettings, folder: Path, carrier_hz: float | None = None) -> geometry.Pattern:
    """Return the element pattern. Files are relative to ``folder``, and the carrier selects the frequency."""
    from ..site import antennas

    # named models have no file, and do not use this path
    file = folder / str(settings.file)
    if settings.model == "dipole":
        return antennas.HalfWaveDipole()
    if settings.model == "tr38901":
        return antennas.TR38901()
    if settings.model == "file":
        from ..site.pattern_files import read_cut_files, read_pattern_file

        if settings.elevation is not None:
            return read_cut_files(file, folder / settings.elevation)
        return read_pattern_file(file, carrier_hz=carrier_hz)
    if settings.model == "sphere":
        return _sphere(settings, file, folder)
    if settings.model == "gain_grid":
        if settings.variable is None:
            raise UsageError("a gain grid without 'variable'", expected="the name of the grid inside the .mat file")
        return antennas.read_gain_grid(file, settings.variable)
    return Isotropic()


def _sphere(settings: AntennaSettings, file: Path, folder: Path) -> geometry.Pattern:
    """Return the pattern of a full sphere. If it is learned, check its SHA-256 and attach its error model."""
    known = settings.learned
    if known is None:
        return read_sphere_csv(file)
    pattern = read_sphere_csv(file, Written(known.sha256, known.command))
    pattern.spread = known.spread
    if (pair := known.pair) is not None:
        written = None if pair.sha256 is None else Written(pair.sha256, known.command)
        pattern.pair = read_pair(folder / pair.file, pair.length, pair.prior_sd_db, written)
    return pattern


class LinkSettings(StrictModel):
    """A radio link: carrier, power, and the arrays at both ends.

    Parameters
    ----------
    bandwidth_hz : float, optional
        Bandwidth of the receiver. A link whose level is below the noise in this bandwidth is out of coverage.
    """

    carrier_hz: CarrierHz
    transmit_power_dbm: Annotated[float, Field(ge=-200, le=100)] = 40.0
    uav_transmits: bool = True
    bandwidth_hz: Positive | None = None
    noise_figure_db: float | None = None
    tower: ArraySettings = ArraySettings()
    towers: dict[str, ArraySettings] = {}
    uav: ArraySettings = ArraySettings()

    @model_validator(mode="after")
    def _one_floor(self) -> LinkSettings:
        if self.noise_figure_db is not None and self.bandwidth_hz is None:
            raise ValueError("noise_figure_db needs bandwidth_hz")
        return self

    @property
    def floor_dbm(self) -> float:
        """The noise floor of the receiver [dBm] in its bandwidth, or in 1 Hz if the bandwidth is unknown."""
        return noise_floor_dbm(self.bandwidth_hz or 1.0, self.noise_figure_db or 0.0)

    def build(self, tower_names: list[str], folder: Path) -> geometry.Link:
        """Return the link to the named towers."""
        wavelength = wavelength_m(self.carrier_hz)
        arrays = {name: self.towers.get(name, self.tower).build(wavelength, folder) for name in tower_names}
        return geometry.Link(
            carrier_hz=self.carrier_hz,
            transmit_power_dbm=self.transmit_power_dbm,
            uav_transmits=self.uav_transmits,
            tower_arrays=arrays,
            uav_array=self.uav.build(wavelength, folder),
            noise_floor_dbm=self.floor_dbm,
        )


class LinksSettings(StrictModel):
    """The RSS and rank links.

    The defaults are the arrays of the paper: single elements at 3.3 GHz, and 4 x 4 at 3.4 GHz.

    Parameters
    ----------
    channels : mapping of str to LinkSettings
        RSS links of channels that differ from ``rss``, by channel name (for example two antennas).
    """

    rss: LinkSettings = LinkSettings(carrier_hz=3.3e9)
    channels: dict[str, LinkSettings] = {}
    rank: LinkSettings = LinkSettings(
        carrier_hz=3.4e9,
        uav_transmits=False,
        bandwidth_hz=20e6,  # the rank is limited by the noise in the modem's channel, not in 1 Hz
        tower=ArraySettings(layout="tower_comparison", slant_deg=[45.0, -45.0, 45.0, -45.0], yaw_deg=45.0),
        uav=ArraySettings(layout="uav_comparison", slant_deg=[45.0, -45.0, -45.0, 45.0], yaw_deg=315.0, roll_deg=90.0),
    )

    def of(self, channel: str) -> LinkSettings:
        """Return the RSS link of a channel."""
        return self.channels.get(channel, self.rss)


class LogSettings(StrictModel):
    """A log file, and facts that it does not contain.

    Parameters
    ----------
    gps_rollovers : int
        Number of rollovers of the GPS week number in this log. Each rollover adds 1 024 weeks to the times.
    cells : mapping of int or str to str
        Tower of each cell, by PCI or name of the stream. Cells that are not listed are ignored.
    height_m : float, optional
        Height above take-off of the whole track [m], for a log without altitudes.
    skip : list of str
        Names of the streams of the file to ignore.
    receiver : str
        Name of the receiver that wrote the log, if the log does not contain it. Learned levels belong to a receiver.
    """

    path: str
    reader: str | None = None
    node: str | None = None
    channel: str | None = None
    frequency_hz: CarrierHz | None = None
    timezone: str | None = None
    clock: Literal["local", "utc", "local_as_utc"] | None = None
    time_origin: str | None = None
    gps_rollovers: Annotated[int, Field(ge=0, le=3)] = 0
    ri_base: Literal["zero", "one"] | None = None
    columns: dict[str, str] = {}
    kind: Kind | None = None
    unit: str | None = None
    floor_db: float = -200.0
    cells: dict[Annotated[int | str, Field(union_mode="left_to_right")], str] = {}
    height_m: float | None = Field(default=None, ge=-1000.0, le=20_000.0)
    skip: list[str] = []
    receiver: str = ""

    @property
    def reader_name(self) -> str | None:
        """The name of the reader, or None if it is detected by content. With ``columns``, it is generic_csv."""
        return self.reader or ("generic_csv" if self.columns else None)

    def options(self, timezone: str | None) -> ReadOptions:
        """Return the options of the log's reader. The default time zone is that of the flight."""
        return ReadOptions(
            timezone=self.timezone or timezone,
            ri_base=self.ri_base,
            clock=self.clock, time_origin=self.time_origin, gps_rollovers=self.gps_rollovers, columns=self.columns,
            kind=self.kind, node=self.node, channel=self.channel, frequency_hz=self.frequency_hz, unit=self.unit,
            floor_db=self.floor_db,
        )  # fmt: skip


class Waypoint(StrictModel):
    """A planned point at ``height_m`` above the ground at the origin. The UAV waits there for ``hold_s`` seconds."""

    label: str = ""
    east_m: float
    north_m: float
    height_m: float
    hold_s: Annotated[float, Field(ge=0)] = 0.0


class PlanSettings(StrictModel):
    """The plan of a simulated flight, and the true errors of its logs, which ``simulate`` writes to truth.json.

    Parameters
    ----------
    start : datetime
        Local time in the time zone of the flight.
    offsets_db : mapping of str to mapping of str to float
        Offset that is added to the measurement, by tower and channel. The comparison should recover it.
    fading_db : float
        Standard deviation of log-normal fading.
    clock_shift_s : mapping of str to float
        Radio clock minus telemetry clock [s], by tower.
    bad_lines : int
        Number of damaged lines per log file.
    rank_k : float
        Singular-value ratio of the simulated modem.
    rank_error_share : float
        Share of reports whose rank is wrong by one layer.
    no_csi_share : float
        Share of reports with RI 0 (no CSI).
    """

    start: datetime
    waypoints: Annotated[list[Waypoint], Field(min_length=2)]
    speed_mps: Positive = 8.0
    climb_mps: Positive = 3.0
    seed: int = 1
    telemetry_interval_s: Positive = 1.0
    rss_interval_s: Positive = 0.1
    rank_interval_s: Positive = 0.5
    offsets_db: dict[str, dict[str, float]] = {}
    fading_db: Annotated[float, Field(ge=0)] = 0.0
    fading_correlation_s: Positive = 2.0
    clock_shift_s: dict[str, float] = {}
    bad_lines: Annotated[int, Field(ge=0)] = 0
    rank_k: Annotated[float, Field(ge=1.0)] = 100.0
    rank_error_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    no_csi_share: Annotated[float, Field(ge=0, le=1)] = 0.0


class FlightSettings(StrictModel):
    """The name and kind of the flight."""

    # the name of the report's folder must not have spaces, separators or a leading dot
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$")]
    title: str | None = None
    synthetic: bool = False
    notes: list[str] = []
    plan: PlanSettings | None = None


class SiteChoice(StrictModel):
    """The site of a flight, and changes to it for this flight.

    Parameters
    ----------
    coordinates : str, optional
        Name of a published coordinate set of the packaged site.
    antenna_height_m : float, optional
        Antenna height of every tower [m], replacing the heights of the site.
    tower_ground : {"flat", "offsets", "surface", "dem"}, optional
        Model of the ground at the towers and below the paths, which replaces the model of the site.
    """

    file: str = "lake_wheeler"
    coordinates: str | None = None
    antenna_height_m: Positive | None = None
    without_buildings: bool = False
    tower_ground: Literal["flat", "offsets", "surface", "dem"] | None = None


class GroundNode(StrictModel):
    """The position or track of a node that is not in the site, such as a rover or a second UAV.

    Parameters
    ----------
    track : LogSettings, optional
        Log with the positions of the node. A node that stays within ``STANDS_STILL_M`` is placed at the median
        position.
    height : {"ground", "logged"}
        ``ground``: the antenna is ``antenna_height_m`` above the ground. ``logged``: at the height of the track.
    region90_m : float, optional
        Radius of the 90 % region of a position that was chosen by the levels [m]. Remove it for a measured position.
    """

    latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] | None = None
    track: LogSettings | None = None
    height: Literal["ground", "logged"] = "ground"
    antenna_height_m: Positive = 1.5
    region90_m: Positive | None = None

    @field_validator("track", mode="before")
    @classmethod
    def _a_path_is_a_log(cls, value: object) -> object:
        return {"path": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _a_place_or_a_track(self) -> GroundNode:
        stated = (self.latitude_deg is not None, self.longitude_deg is not None)
        if stated not in ((True, True), (False, False)) or all(stated) == (self.track is not None):
            raise ValueError("a tower needs latitude_deg and longitude_deg, or a track")
        if self.height == "logged" and self.track is None:
            raise ValueError("height: logged needs a track with heights")
        if self.height == "logged" and "antenna_height_m" in self.model_fields_set:
            raise ValueError("height: logged uses the height of the track; remove antenna_height_m")
        return self


class AdvancedRt(StrictModel):
    """Settings of a replay that few flights need.

    Parameters
    ----------
    samples : {"auto"} or int
        Number of Sionna's rays per tower. ``auto`` increases it until two trial runs find the same paths.
    gamma_db_per_m, maximum_loss_db : float, optional
        Specific attenuation and largest loss, replacing the values of P.833 at the carrier.
    maximum_gap_s : float
        Longest telemetry gap in which positions are interpolated.
    """

    samples: Literal["auto"] | Annotated[int, Field(ge=1, le=100_000_000)] = "auto"
    gamma_db_per_m: Positive | None = None
    maximum_loss_db: Positive | None = None
    maximum_gap_s: Positive = 3.0


class RtSettings(StrictModel):
    """The settings of the replay of a flight.

    Parameters
    ----------
    diffraction : {"none", "edges"}
        Diffraction over one edge of a building. Diffracted paths are included in H, levels and ranks.
    attitude : {"logged", "level", "ignored"}
        ``logged``: the UAV array rotates with the aircraft. ``level``: it rotates with the heading only. ``ignored``:
        it does not rotate.
    reflection_loss_db : float
        Additional loss per reflection, for example due to rough surfaces. Determine it from other flights.
    """

    engine: Literal["image", "sionna"] = "image"
    max_depth: Annotated[int, Field(ge=0, le=3)] = 2
    diffraction: Diffraction = "none"
    attitude: Literal["logged", "level", "ignored"] = "ignored"
    foliage: Literal["none", "attenuating", "opaque"] = "none"
    leaves: Literal["in", "out"] = "in"
    reflection_loss_db: Annotated[float, Field(ge=0)] = 0.0
    audit_links: Annotated[int, Field(ge=0)] = 200
    advanced: AdvancedRt = AdvancedRt()


# Widest search range of offsets [dB]. Offsets are tried in steps of 0.1 dB.
_WIDEST_DB = 100_000.0


class AdvancedRss(StrictModel):
    """Settings of the RSS comparison that few flights need.

    Parameters
    ----------
    lag_window_s : float
        Largest clock difference that is searched for [s].
    """

    lag_window_s: Annotated[float, Field(ge=0.1, le=3600)] = 15.0


class RssSettings(StrictModel):
    """The settings of the RSS comparison.

    Parameters
    ----------
    lag : {"off", "estimate", "apply"} or float
        Radio minus telemetry clock: ``off``, ``estimate`` (only shown), ``apply``, or a value to subtract [s].
    field : {"coherent", "power"}
        Kind of simulated RSS that is compared.
    minimum_height_m : float, optional
        Lowest height of a compared sample. Samples below it are excluded and counted.
    """

    span_db: tuple[float, float] = (-50.0, 50.0)
    lag: Literal["off", "estimate", "apply"] | Annotated[float, Field(ge=-86400, le=86400)] = "estimate"
    field: Literal["coherent", "power"] = "coherent"
    minimum_height_m: float | None = None
    advanced: AdvancedRss = AdvancedRss()

    @field_validator("span_db")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not value[0] < value[1]:
            raise ValueError("span_db must be [lowest, highest]")
        if value[1] - value[0] > _WIDEST_DB:
            raise ValueError(f"span_db is wider than {_WIDEST_DB:g} dB: more than 1000000 offsets to try")
        return value


class RankSettings(StrictModel):
    """The settings of the rank comparison.

    Parameters
    ----------
    minimum_height_m : float, optional
        Lowest height of a compared sample. Samples below it are excluded and counted. Some data sets require this.
    receiver : str, optional
        Receiver file written by ``calibrate``, for the probability of each rank.
    """

    tower: str = "LW1"
    k: Annotated[list[Positive], Field(min_length=1, max_length=64)] = [10.0, 100.0, 1000.0]
    minimum_height_m: float | None = None
    receiver: str | None = None

    @field_validator("k")
    @classmethod
    def _above_one(cls, value: list[float]) -> list[float]:
        if min(value) <= 1:
            raise ValueError("K is a ratio sigma_1/sigma_i and must be greater than 1")
        return value


class ReportSettings(StrictModel):
    """Settings of the contents of the report."""

    waypoints: list[Waypoint] = []


@dataclass(frozen=True, slots=True, kw_only=True)
class Caution:
    """A caution about a learned antenna or receiver that the flight file names.

    Parameters
    ----------
    key : str
        Key of the flight file, such as ``antennas.uav``.
    channel : str, optional
        Channel that the caution concerns. None for all channels that ``link.channels`` does not name.
    text : str
        The antenna or receiver that is not used, with reason and substitute, or the setting that it replaces.
    """

    key: str
    channel: str | None
    text: str
    used: bool = False


LOG_EXAMPLE = "{path: LW1/log.txt, reader: sounder_log, node: LW1}"
_NO_LOGS = (
    "a plan without logs. 'predict' and 'channel' need 'logs: []'; 'report' reads and 'simulate' writes logs that are "
    f"listed as {LOG_EXAMPLE}"
)


class FlightFile(StrictModel):
    """All settings of a flight.yaml.

    Parameters
    ----------
    towers : mapping of str to GroundNode
        Nodes of this flight that are not in the site, such as a rover.
    trained_on : list of str
        SHA-256 of the logs from which settings of this file were learned. These logs are not scored.
    marks : list of str
        Fingerprints of the same logs, to recognise copies.
    logs : list of LogSettings
        Logs of the flight. An empty list is sufficient for a plan or a route.
    antennas : mapping of str to str
        Names of learned antennas for ``uav`` and ``TOWER.CHANNEL``, replacing the antennas in ``link``.
    """

    flight: FlightSettings
    site: SiteChoice = SiteChoice()
    towers: dict[str, GroundNode] = {}
    timezone: str | None = None
    trained_on: list[Annotated[str, Field(pattern="^[0-9a-f]{64}$")]] = []
    marks: list[str] = []
    logs: Annotated[list[LogSettings], Field(description=_NO_LOGS)]
    antennas: dict[str, str] = {}
    link: LinksSettings = LinksSettings()
    rt: RtSettings = RtSettings()
    rss: RssSettings = RssSettings()
    rank: RankSettings = RankSettings()
    report: ReportSettings = ReportSettings()
    _cautions: tuple[Caution, ...] = PrivateAttr(())
    _learned: Mapping[str, Named] = PrivateAttr({})
    _lent: frozenset[str] = PrivateAttr(frozenset())
    _rank_rt: RtSettings | None = PrivateAttr(None)

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """The warnings about named learned antennas and receivers that do not fit and are therefore not used."""
        return self._cautions

    @property
    def learned(self) -> Mapping[str, Named]:
        """The learned models that ``antennas`` names, by its keys."""
        return {key: named for key, named in self._learned.items() if key in self.antennas}

    @property
    def rss_attitude(self) -> str:
        """The value of ``rt.attitude`` with which levels are replayed.

        If the flight file does not specify it and an airframe is learned, the value is ``logged``, because the gain of
        an airframe depends on directions in the axes of the aircraft.
        """
        links = (self.link.rss, *self.link.channels.values())
        learned = any(link.uav.antenna.learned is not None for link in links)
        return "logged" if learned and "attitude" not in self.rt.model_fields_set else self.rt.attitude

    @property
    def rank_rt(self) -> RtSettings:
        """The settings with which ranks are replayed: ``rt`` as the flight file specifies it.

        A calibration changes ``rt`` only for levels.
        """
        return self._rank_rt or self.rt

    @property
    def lent(self) -> frozenset[str]:
        """The channels of ``link.channels`` from a calibration or an override, which this flight may not have."""
        return self._lent

    def changed(
        self,
        content: Mapping[str, Any],
        *,
        cautions: Iterable[Caution] | None = None,
        learned: Mapping[str, Named] | None = None,
        lent: Iterable[str] = (),
    ) -> FlightFile:
        """Return a copy of the settings with new values for some top-level keys, which are not checked.

        Parameters
        ----------
        content : mapping
            New values by key.
        cautions : iterable of Caution, optional
            New warnings about named learned models. None keeps the present warnings.
        learned : mapping of str to Named, optional
            New learned models by key of ``antennas``. None keeps the present models.
        lent : iterable of str
            Further channels that this flight may not have.

        Returns
        -------
        FlightFile
        """
        other = self.model_copy(update=dict(content))
        other._cautions = self._cautions if cautions is None else tuple(cautions)
        other._learned = self._learned if learned is None else learned
        other._lent = self._lent | frozenset(lent)
        return other

    @model_validator(mode="before")
    @classmethod
    def _short_forms(cls, data: Any) -> Any:
        if isinstance(data, dict):
            data = dict(data)
            if isinstance(data.get("flight"), str):
                data["flight"] = {"name": data["flight"]}
            if isinstance(data.get("site"), str):
                data["site"] = {"file": data["site"]}
        return data

    @field_validator("timezone")
    @classmethod
    def _known_zone(cls, value: str | None) -> str | None:
        if value is not None:
            from zoneinfo import ZoneInfo

            try:
                ZoneInfo(value)
            except (KeyError, ValueError, OSError) as error:
                near = nearest_zone(value) or "America/New_York"
                raise ValueError(f"unknown time zone {value!r}; expected an IANA name such as {near}") from error
        return value


class LearnedLink(StrictModel):
    """The links of a calibrated.yaml, which contains only channels."""

    channels: dict[str, dict[str, Any]] = {}


class LearnedSettings(StrictModel):
    """The part of a flight.yaml that a calibration writes to calibrated.yaml."""

    trained_on: list[str] = []
    marks: list[str] = []
    link: LearnedLink = LearnedLink()
    rt: dict[str, Any] = {}
    rank: dict[str, Any] = {}


def load_flight(path: str | Path) -> FlightFile:
    """Read and check a flight.yaml.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    FlightFile
        The settings as written. :func:`aerpaw_cmp.flight.gains.load_with_learned` adds the learned antennas.

    Raises
    ------
    UsageError
        For unknown or duplicate keys, wrong types and values out of range, with the line and the nearest valid key.
    """
    return load_yaml(Path(path), FlightFile)


def files_of(content: Mapping[str, Any], folder: Path, learned: Path | None = None) -> dict[str, Any]:
    """Return settings in which the paths of files are absolute.

    Files that a calibrated.yaml (``learned``) names must be in its folder or below.
    """

    def place(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {name: place(item, name) for name, item in value.items()}
        if isinstance(value, list):
            return [place(item) for item in value]
        if key in ("file", "receiver") and isinstance(value, str):
            return str((folder / value if learned is None else inside(folder, value, learned)).absolute())
        return value

    return dict(place(dict(content)))


def joined(settings: FlightFile, learned: Path) -> FlightFile:
    """Return the settings of a flight, with values replaced by those of a calibrated.yaml.

    Parameters
    ----------
    settings : FlightFile
        Settings of the flight, with learned antennas. An antenna for the same end, tower and channel is replaced.
    learned : Path
        A calibrated.yaml, with its files in the same folder.

    Raises
    ------
    UsageError
        If the file is not a calibrated.yaml, was edited, does not fit this flight, or was learned in another band.
    """
    if learned.is_file():
        check_seal(learned)
    known = files_of(load_yaml(learned, LearnedSettings).model_dump(exclude_unset=True), learned.parent, learned)
    taught: dict[str, Any] = known.get("link", {}).get("channels", {})
    # use only values that the user wrote, because a default must not replace a learned value
    stated: dict[str, Any] = settings.model_dump(mode="json", exclude_unset=True)
    # as with overrides, a new channel starts as a copy of the RSS link; learned values then replace its values
    rss_link = settings.link.rss.model_dump(mode="json", exclude_unset=True)
    channels = dict(stated.get("link", {}).get("channels", {}))
    for name, channel in taught.items():
        before = {**rss_link, **channels.get(name, {})}
        if {"carrier_hz"} <= before.keys() & channel.keys():
            check_band(channel["carrier_hz"], before["carrier_hz"], BAND, f"{learned.name}: antennas of {name} ")
        # a learned 'tower' applies to every tower, but an entry of 'towers' would have priority
        towers = {} if "tower" in channel else before.get("towers", {})
        channels[name] = {**before, **channel, "towers": {**towers, **channel.get("towers", {})}}
    stated["link"] = {**stated.get("link", {}), **({"channels": channels} if channels else {})}
    stated["antennas"] = {key: name for key, name in settings.antennas.items() if not _replaced(key, taught)}
    for key in ("rt", "rank"):
        stated[key] = {**stated.get(key, {}), **known.get(key, {})}
    for key in ("trained_on", "marks"):
        stated[key] = [*stated.get(key, []), *known.get(key, [])]
    try:
        whole = FlightFile.model_validate(stated)
    except ValueError as error:
        raise UsageError(
            f"its settings do not fit this flight: {str(error).splitlines()[-1]}",
            expected="a calibrated.yaml of 'aerpaw-cmp calibrate'",
            path=learned,
        ) from None
    here = {"rank.receiver"} if "receiver" in known.get("rank", {}) else set[str]()
    cautions = [u for u in settings.cautions if u.key not in here and not _replaced(u.key, taught, u.channel)]
    whole._rank_rt = settings.rt
    lent = {*settings.lent, *(taught.keys() - settings.link.channels.keys())}
    return whole.changed({}, cautions=cautions, learned=settings.learned, lent=lent)


def _replaced(key: str, taught: Mapping[str, Any], channel: str | None = None) -> bool:
    """Check whether learned channels have an antenna for the end that a key of ``antennas`` names."""
    tower, _, name = key.removeprefix("antennas.").partition(".")
    if tower == "uav" and channel is None:
        return any("uav" in link for link in taught.values())
    link = taught.get(channel or name, {})
    return "uav" in link if tower == "uav" else "tower" in link or tower in link.get("towers", {})


Overrides = Mapping[str, Any]


def overridden(settings: FlightFile, overrides: Overrides) -> FlightFile:
    """Return flight settings with the values of dotted keys changed, and check them.

    A new channel of ``link.channels`` starts as a copy of ``link.rss``, and a new tower of ``towers`` as a copy of
    ``tower``.

    Raises
    ------
    UsageError
        If a key is unknown (the message names the nearest key) or a value has the wrong kind.
    """
    if not overrides:
        return settings
    plain = settings.model_dump(mode="python")
    # change the originals of copies first, so that the copies have the same values
    for key in sorted(overrides, key=lambda key: (key.startswith("link.channels."), ".towers." in key)):
        _set(plain, key, overrides[key])
    try:
        other = FlightFile.model_validate(plain)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        # name the override that the user wrote, even if the error is at a key above or below it
        key = next((k for k in overrides if k.startswith(where) or where.startswith(k)), where)
        raise UsageError(
            f"the override {key!r}: found {first['input']!r} at {where}", expected=expectation(first)
        ) from None
    # a campaign can change a channel that some of its flights do not have
    return other.changed({}, lent={*settings.lent, *(other.link.channels.keys() - settings.link.channels.keys())})


def _set(plain: dict[str, Any], key: str, value: Any) -> None:
    level: Any = plain
    holder, parts = plain, key.split(".")
    for depth, part in enumerate(parts):
        if not isinstance(level, dict):
            raise UsageError(f"the override {key!r} goes below {'.'.join(parts[:depth])!r}, which has no keys")
        if part not in level:
            level[part] = _new_entry(plain, holder, level, parts[: depth + 1], key)
        holder, level = level, level[part]
    holder[parts[-1]] = value


def _new_entry(plain: dict[str, Any], holder: dict[str, Any], level: dict[str, Any], parts: list[str], key: str) -> Any:
    """Return the initial content of a new entry in a mapping whose keys are free names. Refuse other unknown keys."""
    *above, part = parts
    if above == ["link", "channels"]:
        return deepcopy(plain["link"]["rss"])
    if above[:1] == ["link"] and above[-1] == "towers":
        return deepcopy(holder["tower"])
    near = nearest(part, level)
    raise UsageError(
        f"the override {key!r}: there is no key {part!r}" + (f" below {'.'.join(above)!r}" if above else ""),
        expected="a key of flight.yaml in dotted form",
        cause=f"did you mean {near!r}?" if near else None,
    )
