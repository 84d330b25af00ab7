"""What to simulate: one frozen tree of settings, in physical units, with one seed."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from frontends.errors import InputError
from frontends.measurements import SunDirection
from lunar_fg.datasets.strict_yaml import read_yaml

#: Part of the cache key: raise it when the same spec gives other pixels than before.
RENDERER_VERSION = 3

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-360.0, le=360.0, allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SunSpec(_Strict):
    """Direction to the Sun: azimuth clockwise from map north, elevation above level, deg."""

    azimuth_deg: Angle = 150.0
    elevation_deg: Annotated[float, Field(gt=0.0, le=90.0)] = 18.0

    def direction(self) -> SunDirection:
        """The vocabulary's form."""
        return SunDirection(self.azimuth_deg, self.elevation_deg)


class TerrainSpec(_Strict):
    """Relief, craters and rocks.

    Attributes
    ----------
    hurst, hurst_below_1m
        Exponents of the fractal relief above and below a wavelength of 1 m.
    roughness_m
        RMS height of the octave of relief that is 1 m long (half a metre to a metre).
    crater_density
        Craters larger than D metres a square metre, times D^2. The equilibrium that small
        lunar craters keep is about 0.08 (5 % of geometric saturation).
    rock_density, rock_exponent
        Rocks larger than D metres a square metre: ``density * D ** -exponent``. Surveyor I
        counted 2.3e-3 and 2.11.
    dem
        GeoTIFF with the base relief; finer detail than it holds is added.
    """

    hurst: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.85
    hurst_below_1m: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.6
    roughness_m: NotNegative = 0.007
    crater_density: NotNegative = 0.05
    rock_density: NotNegative = 1.2e-3
    rock_exponent: Annotated[float, Field(ge=1.0, le=3.0)] = 2.11
    dem: Path | None = None


class CameraSpec(_Strict):
    """The stereo pair on its mast and how it takes pictures.

    Attributes
    ----------
    width, height
        px.
    field_of_view_deg
        Horizontal.
    baseline_m, forward_m, up_m, down_tilt_deg
        Mount of the left camera; it is half a baseline left of the rover's middle.
    supersampling
        Rays a pixel, along each side.
    psf_sigma_px
        Optical blur on top of the pixel's own area.
    full_well_e, read_noise_e
        Electrons at white, and of noise when dark.
    exposure
        Share of white that auto-exposure gives to the brightest hundredth of the ground.
    fill_light
        Light in shadows, from the sunlit ground around, as a share of the direct light.
    k1, k2
        Brown's radial distortion that is left in the images (0: rectified perfectly).
    vertical_misalignment_px
        Rows by which the right image lies too low, at its middle.
    """

    width: Annotated[int, Field(ge=32, le=4096)] = 512
    height: Annotated[int, Field(ge=32, le=4096)] = 512
    field_of_view_deg: Annotated[float, Field(ge=10.0, le=120.0)] = 60.0
    baseline_m: Positive = 0.3
    forward_m: float = 0.3
    up_m: Positive = 1.3
    down_tilt_deg: Annotated[float, Field(ge=-45.0, le=90.0)] = 22.0
    supersampling: Annotated[int, Field(ge=1, le=8)] = 2
    psf_sigma_px: NotNegative = 0.5
    full_well_e: Positive = 15_000.0
    read_noise_e: NotNegative = 25.0
    exposure: Annotated[float, Field(gt=0.0, le=1.0)] = 0.85
    fill_light: NotNegative = 0.02
    k1: float = 0.0
    k2: float = 0.0
    vertical_misalignment_px: float = 0.0


class PathSpec(_Strict):
    """The drive.

    Attributes
    ----------
    length_m, step_m
        Length, and distance between stereo pairs.
    speed_m_s
        Makes the time stamps.
    waypoint_offset_m
        How far to the sides of the straight line (of the circle) the waypoints lie.
    circuit_m
        Circumference of a circle that is driven around until the length is reached, each time
        a little beside the tracks before; None: a drive to the east.
    wheel_base_m, track_m
        Distances between the wheels' contacts, along and across.
    """

    length_m: Annotated[float, Field(ge=1.0, le=5_000.0)] = 100.0
    step_m: Positive = 1.5
    speed_m_s: Positive = 0.1
    waypoint_offset_m: NotNegative = 8.0
    circuit_m: Annotated[float, Field(ge=30.0, le=2_000.0)] | None = None
    wheel_base_m: Positive = 1.2
    track_m: Positive = 1.0


class SensorSpec(_Strict):
    """Wheel odometry and attitude; see `lunar_fg.simulation.sensors` for the models."""

    slip: NotNegative = 0.02
    slip_per_slope: NotNegative = 0.5
    slip_sigma: NotNegative = 0.02
    side_slip_per_slope: NotNegative = 0.15
    heading_over_read: float = 0.03
    heading_bias_deg_per_m: float = 0.05
    heading_sigma_deg: NotNegative = 0.15
    odometry_spacing_m: Positive = 0.1
    tilt_bias_deg: NotNegative = 0.15
    tilt_sigma_deg: NotNegative = 0.1
    yaw_offset_deg: NotNegative = 0.5
    yaw_drift_deg: NotNegative = 0.1
    start_sigma_m: Positive = 0.3
    start_sigma_tilt_deg: Positive = 0.2
    start_sigma_yaw_deg: Positive = 0.5


class OrbitalSpec(_Strict):
    """The map from orbit.

    Attributes
    ----------
    gsd_m
        Pixel of the ortho image; the DEM's is twice that, its resolution four times.
    margin_m
        Map beyond the drive, on all sides.
    sun
        Light of the ortho image.
    psf_sigma_px, snr
        Blur, and signal to noise at mean brightness, of the ortho image.
    dem_sigma_px
        Height noise of the DEM, in ortho pixels.
    wrong_map
        Whether to make a map of another place too, for refusal tests.
    crs, origin
        Of the map frame: projected CRS, and where its zero lies (east, north, height; m).
        With a base DEM, both come from its file.
    """

    gsd_m: Annotated[float, Field(ge=0.05, le=20.0)] = 0.25
    margin_m: Positive = 60.0
    sun: SunSpec = SunSpec(azimuth_deg=285.0, elevation_deg=35.0)
    psf_sigma_px: NotNegative = 0.7
    snr: Positive = 60.0
    dem_sigma_px: NotNegative = 0.2
    wrong_map: bool = True
    crs: str = "IAU_2015:30135"
    origin: tuple[float, float, float] = (12_000.0, -8_000.0, -1_500.0)


class SimulationSpec(_Strict):
    """The whole traverse.

    Attributes
    ----------
    seed
        Of every random choice.
    sun
        During the drive.
    later_sun
        During its second half; None: the same.
    depth
        Whether to write each left image's depth.
    """

    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    sun: SunSpec = SunSpec()
    later_sun: SunSpec | None = None
    terrain: TerrainSpec = TerrainSpec()
    camera: CameraSpec = CameraSpec()
    path: PathSpec = PathSpec()
    sensors: SensorSpec = SensorSpec()
    orbital: OrbitalSpec = OrbitalSpec()
    depth: bool = False

    def key(self) -> str:
        """Name of what this spec gives: changes with any setting, the DEM's bytes, the code.

        Raises
        ------
        InputError
            When the DEM cannot be read.
        """
        digest = hashlib.sha256(f"{RENDERER_VERSION}:{self.model_dump_json()}".encode())
        if self.terrain.dem is not None:
            try:
                digest.update(self.terrain.dem.read_bytes())
            except OSError as error:
                problem = f"cannot be read: {error.strerror}"
                raise InputError(problem, source=self.terrain.dem) from error
        return f"simulated-{digest.hexdigest()[:10]}"


def read_spec(path: Path) -> SimulationSpec:
    """Read a spec from YAML; keys that are left out keep their default.

    Raises
    ------
    InputError
        When the file cannot be read, or a key or value is wrong.
    """
    return checked_spec(read_yaml(path) or {}, path)


def checked_spec(data: object, source: Path | str) -> SimulationSpec:
    """Make a spec of plain data, or say in one line what is wrong.

    Raises
    ------
    InputError
        When a key or value is wrong.
    """
    try:
        return SimulationSpec.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            str(first["msg"]).lower(),
            source=source,
            field=".".join(str(part) for part in first["loc"]),
            remedy="simulation.yaml of any simulated dataset lists all keys",
        ) from error
