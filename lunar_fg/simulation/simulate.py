"""A whole simulated traverse: ground, drive, sensors, pictures, map; as a dataset folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lunar_fg.simulation import dataset
from lunar_fg.simulation.camera import camera_mount, take_pair
from lunar_fg.simulation.drive import Drive, drive_along, plan_route, region_of
from lunar_fg.simulation.levels import Level, make_levels
from lunar_fg.simulation.orbital import MapFrame, as_dem, as_photograph, look_down
from lunar_fg.simulation.parallel import in_processes
from lunar_fg.simulation.rocks import Rocks, draw_rocks, mesh_rocks
from lunar_fg.simulation.scene import Scene
from lunar_fg.simulation.sensors import attitude, start_prior, wheel_odometry
from lunar_fg.simulation.spec import SimulationSpec
from lunar_fg.simulation.terrain import Extent, Terrain, make_terrain
from lunar_fg.simulation.texture import make_texture

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]
Result = TypeVar("Result")

#: Called with what is being done, how much of it is done, and how much there is.
Progress = Callable[[str, int, int], None]

#: Added to the seed for the place that the wrong map shows.
_ELSEWHERE = 1_000_003
_STRIP_ROWS = 64


@dataclass(frozen=True, slots=True)
class World:
    """A place with a drive through it.

    Attributes
    ----------
    terrain, scene
        The ground as a function, and as meshes with the rocks.
    later_scene
        The same under the later sun, where there is one: grains cast shadows in the texture.
    rocks
        Where they lie.
    drive
        Densely sampled truth.
    frames
        (N,) indices of the stereo frames into the drive.
    map_frame
        Pixels of the orbital image.
    """

    terrain: Terrain
    scene: Scene
    later_scene: Scene | None
    rocks: Rocks
    drive: Drive
    frames: NDArray[np.int64]
    map_frame: MapFrame

    def map_T_rover(self) -> FloatArray:
        """True poses at the stereo frames, (N, 4, 4)."""
        return self.drive.map_T_rover[self.frames]


def build_world(spec: SimulationSpec) -> World:
    """Make the ground and drive over it.

    Raises
    ------
    InputError
        When the base relief cannot be used or is too small for the drive.
    """
    near = _map_extent(spec)
    terrain = make_terrain(spec.terrain, spec.seed, near)
    dataset.check_room(spec, terrain.extent, near)
    route = plan_route(terrain, spec.path, np.random.default_rng([spec.seed, 2]))
    levels = make_levels(terrain, route, near)
    drive = drive_along(route, levels[-1], spec.path, spec.sensors.side_slip_per_slope)
    steps = np.arange(0.0, spec.path.length_m + 1e-6, spec.path.step_m)
    scene, rocks = _scene(spec, levels, route[::10])
    later = None
    if spec.later_sun is not None:
        later, _ = _scene(spec.model_copy(update={"sun": spec.later_sun}), levels, route[::10])
    return World(
        terrain,
        scene,
        later,
        rocks,
        drive,
        drive.nearest(steps),
        MapFrame.covering(near, spec.orbital.gsd_m),
    )


def simulate(
    spec: SimulationSpec,
    folder: Path,
    *,
    workers: int | None = None,
    on_progress: Progress | None = None,
) -> None:
    """Render a traverse and write it as a dataset (docs/formats.md, docs/simulator.md).

    Parameters
    ----------
    spec
        What to simulate.
    folder
        New or empty.
    workers
        Processes; default the cores.
    on_progress
        Told how far it is.

    Raises
    ------
    InputError
        When the folder or the spec cannot be used.
    """
    tell: Progress = on_progress or (lambda _what, _done, _of: None)
    dataset.prepare(folder)
    tell("terrain", 0, 1)
    world = build_world(spec)
    _write_tables(spec, world, folder)
    _write_maps(spec, world, folder, workers, tell)
    mount = camera_mount(spec.camera)
    poses = world.map_T_rover() @ mount
    later = len(poses) if world.later_scene is None else len(poses) // 2
    photographer = _Photographer(world.scene, poses, spec, folder)
    _each(photographer, range(later), workers, "stereo frames", tell)
    if world.later_scene is not None and spec.later_sun is not None:
        other = spec.model_copy(update={"sun": spec.later_sun})
        photographer = _Photographer(world.later_scene, poses, other, folder)
        _each(photographer, range(later, len(poses)), workers, "later stereo frames", tell)
    dataset.write_spec(folder, spec)


@dataclass(frozen=True, slots=True)
class _Photographer:
    """Takes the pair of one frame and writes it."""

    scene: Scene
    map_T_camera: FloatArray
    spec: SimulationSpec
    folder: Path

    def __call__(self, index: int) -> None:
        spec = self.spec
        # a generator a frame: the bytes do not depend on which process takes it when
        rng = np.random.default_rng([spec.seed, 5, index])
        pose, sun = self.map_T_camera[index], spec.sun.direction()
        pair = take_pair(self.scene, pose, spec.camera, sun, rng, depth=spec.depth)
        dataset.write_pair(self.folder, index, pair)


@dataclass(frozen=True, slots=True)
class _Scanner:
    """Looks down on a strip of the map."""

    scene: Scene
    frame: MapFrame
    spec: SimulationSpec

    def __call__(self, first: int) -> Float32:
        last = min(first + _STRIP_ROWS, self.frame.rows)
        strip = self.frame.strip(first, last)
        return look_down(self.scene, strip, self.spec.orbital, self.spec.camera.fill_light)


def _each(
    work: Callable[[int], Result], jobs: range, workers: int | None, what: str, tell: Progress
) -> dict[int, Result]:
    results: dict[int, Result] = {}
    tell(what, 0, len(jobs))
    for job, result in in_processes(work, jobs, workers):
        results[job] = result
        tell(what, len(results), len(jobs))
    return results


def _map_extent(spec: SimulationSpec) -> Extent:
    west, south, east, north = region_of(spec.path)
    margin = spec.orbital.margin_m
    return (west - margin, south - margin, east + margin, north + margin)


def _scene(
    spec: SimulationSpec, levels: tuple[Level, ...], drive: FloatArray
) -> tuple[Scene, Rocks]:
    rng = np.random.default_rng([spec.seed, 3])
    xy = 0.5 * (drive.min(axis=0) + drive.max(axis=0))
    middle = np.array([*xy, float(ground_height(levels, xy[None, :])[0])])
    relief, sun = spec.terrain, spec.sun.direction()
    # below 10 cm slopes hardly grow any more (Helfenstein & Shepard 1999)
    fine = make_texture(
        rng,
        texel_m=0.005,
        size=2048,
        waves_m=(0.014, 0.1),
        exponent=0.8,
        rms_at_1m=relief.roughness_m,
        tone_rms=0.08,
        sun=sun,
    )
    medium = make_texture(
        rng,
        texel_m=0.05,
        size=1024,
        waves_m=(0.1, 0.4),
        exponent=relief.hurst_below_1m,
        rms_at_1m=relief.roughness_m,
        tone_rms=0.05,
        sun=None,
    )
    drawn = draw_rocks(relief, rng, drive)
    rocks = mesh_rocks(drawn, ground_height(levels, drawn.xy), middle, rng)
    return Scene(levels, rocks, fine, medium, middle), drawn


def ground_height(levels: tuple[Level, ...], xy: FloatArray) -> FloatArray:
    """Height of the meshed ground at points (N, 2), m."""
    height = np.empty(len(xy))
    for level in levels:
        frame = level.frame
        j, i = np.floor((xy - [frame.x0, frame.y0]) / frame.spacing_m).astype(int).T
        rows, columns = level.cells.shape
        inside = (i >= 0) & (j >= 0) & (i < rows) & (j < columns)
        inside[inside] = level.cells[i[inside], j[inside]]
        height[inside] = level.at(xy[inside, 0], xy[inside, 1])
    return height


def _write_tables(spec: SimulationSpec, world: World, folder: Path) -> None:
    # a generator an instrument: what one draws does not change the others
    wheels, inclinometer, prior = (np.random.default_rng([spec.seed, 4, k]) for k in range(3))
    speed = spec.path.speed_m_s
    poses = world.map_T_rover()
    distance = world.drive.distance_m[world.frames]
    dataset.write_frames(folder, distance / speed)
    dataset.write_truth(folder, distance / speed, poses, camera_mount(spec.camera))
    dataset.write_odometry(folder, wheel_odometry(world.drive, speed, spec.sensors, wheels))
    measured = attitude(poses, distance, distance / speed, spec.sensors, inclinometer)
    dataset.write_attitude(folder, measured)
    start = start_prior(poses[0], spec.sensors, prior)
    dataset.write_traverse(folder, spec, start, world.terrain.base)


def _write_maps(
    spec: SimulationSpec, world: World, folder: Path, workers: int | None, tell: Progress
) -> None:
    _write_map(spec, world.scene, world, folder / "orbital", 6, workers, tell)
    if not spec.orbital.wrong_map:
        return
    # another place of the same kind, in the same coordinates: no rover was ever there
    elsewhere = spec.model_copy(update={"seed": (spec.seed + _ELSEWHERE) % 2**31})
    near = _map_extent(spec)
    other = make_terrain(spec.terrain.model_copy(update={"dem": None}), elsewhere.seed, near)
    line = np.stack([np.linspace(near[0], near[2], 500), np.zeros(500)], axis=1)
    levels = make_levels(other, line[::500], near)
    scene, _ = _scene(elsewhere, levels, line)
    _write_map(spec, scene, world, folder / "orbital_wrong", 7, workers, tell)


def _write_map(
    spec: SimulationSpec,
    scene: Scene,
    world: World,
    folder: Path,
    stream: int,
    workers: int | None,
    tell: Progress,
) -> None:
    frame = world.map_frame
    strips = range(0, frame.rows, _STRIP_ROWS)
    scanner = _Scanner(scene, frame, spec)
    results = _each(scanner, strips, workers, f"{folder.name} image", tell)
    radiance = np.concatenate([results[first] for first in strips])
    rng = np.random.default_rng([spec.seed, stream])
    ortho = as_photograph(radiance, spec.orbital, rng)
    dem = as_dem(bare_ground(scene, frame), spec.orbital, rng)
    dataset.write_map(folder, spec, frame, ortho, dem, world.terrain.base)


def bare_ground(scene: Scene, frame: MapFrame) -> Float32:
    """Height of the meshed ground at a map's pixels, (H, W), m."""
    x = frame.west + frame.gsd_m * (np.arange(frame.columns) + 0.5)
    y = frame.north - frame.gsd_m * (np.arange(frame.rows) + 0.5)
    grid_x, grid_y = np.meshgrid(x, y)
    xy = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
    return ground_height(scene.levels, xy).reshape(grid_x.shape).astype(np.float32)
