import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from frontends.absolute import AbsoluteConfig, Adjustment
from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.errors import InputError
from frontends.geometry import yaw_pitch_roll
from frontends.measurements import AbsoluteFix, StartPrior, StereoFrame, Verdict
from frontends.orbital import OrbitalMap
from frontends.rectification import RectificationError
from lunar_fg.fix_pictures import FixPictures, picture_of
from lunar_fg.graph.ledger import LedgerEntry, Ruling
from lunar_fg.graph.planar import Planar
from lunar_fg.localisation import Localisation, LocalisationConfig
from lunar_fg.orbital_files import MapConfig, open_orbital, place
from tests.frontends.absolute.relief import drive, heightfield, moved, see, write_dem, write_map

CAMERA = StereoCamera(64, 48, 60.0, 60.0, 31.5, 23.5, 0.2)


class Smoother:
    """Knows estimated poses; believes every fix unless told otherwise."""

    def __init__(self, poses, sigma_m=0.5, accepts=True):
        self.poses, self.sigma_m, self.accepts, self.fixes = poses, sigma_m, accepts, []

    def predicted(self, frame):
        pose = self.poses[frame]
        mean = np.array([*pose[:2, 3], yaw_pitch_roll(pose)[0]])
        planar = Planar(mean, np.diag([self.sigma_m**2] * 2 + [0.01**2]))
        return SimpleNamespace(map_T_rover=pose, planar=lambda: planar)

    def motion(self, first, second):
        return Planar(np.zeros(3), np.diag([1e-3**2, 1e-3**2, 1e-4**2]))

    def add_fix(self, fix):
        self.fixes.append(fix)
        return SimpleNamespace(accepted=self.accepts and bool(fix.candidates))


class Ground:
    """Stands for dense stereo: gives what a heightfield shows at the true pose."""

    def __init__(self, z, poses):
        self.terrain = see(z, poses)

    def measure(self, frame, rectification, near_m=None):
        return self.terrain.points(frame.index)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    z = heightfield(11)
    folder = tmp_path_factory.mktemp("maps")
    poses = drive(44, 1.0, (12.0, 30.0), 0.1)
    return z, write_map(folder / "ortho.tif", z), write_dem(folder / "dem.tif", z), poses


def follow(world, estimate, smoother, attempts=None, **config):
    z, ortho, _, poses = world
    localisation = Localisation(
        CAMERA, level_rover_T_camera(), OrbitalMap.open(ortho),
        LocalisationConfig(**config), AbsoluteConfig(),
    )  # fmt: skip
    localisation._dense = Ground(z, poses)
    localisation.on_attempt = [].append if attempts is None else attempts.append
    image = np.zeros((48, 64), dtype=np.uint8)
    for k, pose in estimate.items():
        frame = StereoFrame(k, float(k), image, image, CAMERA)
        if localisation.observe(frame, None, RectificationError(), pose):
            localisation.fix(smoother)
    return localisation


def test_fixes_come_with_new_ground_and_hit_the_truth(world):
    poses = world[3]
    estimate = moved(poses, 1.2, -0.9, 0.01, 0)
    smoother = Smoother(estimate)
    attempts = []
    follow(world, estimate, smoother, attempts)
    found = [fix for fix in smoother.fixes if fix.candidates]
    assert len(found) == 2  # 43 m, a fix every 20 m
    for fix in found:
        true, best = poses[fix.frame], fix.candidates[0]
        assert math.hypot(best.x_m - true[0, 3], best.y_m - true[1, 3]) < 0.15
    assert "fix by relit relief" in str(attempts[0])
    # no keyframe's ground serves two fixes
    assert abs(found[0].frame - found[1].frame) >= 19


def test_ground_from_before_the_rover_was_carried_is_not_used(world):
    z, ortho, _, poses = world
    smoother = Smoother(poses)
    localisation = Localisation(CAMERA, level_rover_T_camera(), OrbitalMap.open(ortho))
    localisation._dense = Ground(z, poses)
    image = np.zeros((48, 64), dtype=np.uint8)
    for k, pose in poses.items():
        if k == 15:
            localisation.lose()
        localisation.observe(
            StereoFrame(k, float(k), image, image, CAMERA), None, RectificationError(), pose
        )
        localisation.fix(smoother)
    # 20 m of ground make a fix: the first from frame 15 on, in its middle
    assert smoother.fixes[0].frame >= 24


def test_a_carried_rover_is_looked_for_at_any_heading(world):
    poses = world[3]

    class Lost(Smoother):
        def predicted(self, frame):
            pose = self.poses[frame]
            mean = np.array([*pose[:2, 3], yaw_pitch_roll(pose)[0]])
            planar = Planar(mean, np.diag([20.0, 20.0, 1.0]) ** 2)
            return SimpleNamespace(map_T_rover=pose, planar=lambda: planar)

    astray = moved(poses, 11.0, -7.0, 2.4, 0)
    smoother = Lost(astray)
    follow(world, dict(list(astray.items())[:22]), smoother)
    found = [fix for fix in smoother.fixes if fix.candidates]
    assert found
    for fix in found:
        true, best = poses[fix.frame], fix.candidates[0]
        assert math.hypot(best.x_m - true[0, 3], best.y_m - true[1, 3]) < 0.3
        assert abs(math.remainder(best.yaw_rad - yaw_pitch_roll(true)[0], math.tau)) < 0.05


def test_an_uncertain_rover_tries_earlier(world):
    estimate = world[3]
    unsure = Smoother(estimate, sigma_m=2.5)
    follow(world, dict(list(estimate.items())[:20]), unsure)
    calm = Smoother(estimate, sigma_m=0.3)
    follow(world, dict(list(estimate.items())[:20]), calm)
    assert unsure.fixes
    assert not calm.fixes


def test_a_refused_attempt_is_repeated_with_more_ground(world):
    estimate = world[3]
    smoother = Smoother(estimate, accepts=False)
    attempts = []
    localisation = follow(world, estimate, smoother, attempts)
    frames = [fix.frame for fix in smoother.fixes]
    assert len(frames) >= 3
    assert "0 were believed" in localisation.warnings[0]
    assert len(set(frames)) == len(frames)  # the ledger takes each keyframe once
    areas = [attempt.patch.area_m2 for attempt in attempts]
    assert areas[1] > areas[0]


def test_an_attempt_is_drawn_with_what_was_compared(world, tmp_path):
    poses = world[3]
    estimate = moved(poses, 1.2, -0.9, 0.01, 0)
    attempts = []
    follow(world, estimate, Smoother(estimate), attempts)
    attempt = attempts[0]
    pictures = FixPictures(tmp_path / "fixes")
    pictures.draw(attempt)
    image = cv2.imread(str(pictures.path(attempt.fix.frame)))
    panels = np.array_split(image, 5, axis=1)
    assert all(panel.std() > 20.0 for panel in panels)
    best, patch = attempt.fix.candidates[0], attempt.patch
    grid = attempt.proposals[0].window.grid
    drawn = picture_of(attempt)
    # its middle is marked in the fourth panel, which shows the whole window
    side = (drawn.shape[1] - 4 * 6) // 5
    scale = side / max(grid.rows, grid.columns)
    column, row = grid.pixel(np.array(best.x_m), np.array(best.y_m))
    at = (
        round(20 + (float(row) + 0.5) * scale),
        round(3 * (side + 6) + (float(column) + 0.5) * scale),
    )
    around = drawn[at[0] - 3 : at[0] + 4, at[1] - 3 : at[1] + 4].reshape(-1, 3).tolist()
    assert [90, 170, 40] in around
    assert math.hypot(best.x_m - patch.x_m, best.y_m - patch.y_m) > 1.0


def test_an_attempt_without_ground_is_drawn_empty(world):
    nothing = Adjustment(AbsoluteFix(3, reason="too small: no ground was seen"), None, ())
    assert picture_of(nothing)[25:].min() == 250


def test_a_map_that_does_not_fit_is_said_and_costs_nothing(world, tmp_path):
    dataset = SimpleNamespace(
        map_reference=None, start=StartPrior(np.eye(4)), orbital=None, path=tmp_path
    )
    dataset.start.map_T_rover[:2, 3] = [5000.0, 0.0]
    with pytest.raises(InputError, match="does not hold the rover's start"):
        place(world[1], None, None, dataset)
    assert open_orbital(dataset, MapConfig()) is None
    dataset.orbital = SimpleNamespace(ortho=world[1], dem=None, sun=None)
    assert open_orbital(dataset, MapConfig()) is None  # a warning, the run goes on
    dataset.start.map_T_rover[:2, 3] = [12.0, 30.0]
    assert open_orbital(dataset, MapConfig()).sun.azimuth_deg == 285.0
    assert open_orbital(dataset, MapConfig(use=False)) is None


def test_an_unstated_sun_is_estimated_where_there_is_an_elevation_model(world, tmp_path, caplog):
    ortho = write_map(tmp_path / "o.tif", world[0], tags=False)
    dataset = SimpleNamespace(map_reference=None, start=StartPrior(np.eye(4)), orbital=None)
    dataset.start.map_T_rover[:2, 3] = [40.0, 40.0]
    found = place(ortho, world[2], None, dataset)
    assert abs(math.remainder(found.sun.azimuth_deg - 285.0, 360.0)) < 10.0
    assert "not stated" in caplog.text
    assert place(ortho, None, None, dataset).sun is None


def test_an_interrupted_run_goes_on_with_the_same_ground(world):
    estimate = world[3]
    smoother = Smoother(estimate)
    first = {k: estimate[k] for k in range(28)}
    whole = follow(world, first, smoother)
    entries, tried = [], iter(smoother.fixes)
    for fix in tried:
        verdict = Verdict.ACCEPTED if fix.candidates else Verdict.REFUSED
        at = next(a for a in sorted(first) if a >= 20)
        entries.append(LedgerEntry(0, fix, (Ruling(at, verdict, 0, 1.0, "", 0),)))
    assert len(entries) == 1
    image = np.zeros((48, 64), dtype=np.uint8)
    frames = [StereoFrame(k, float(k), image, image, CAMERA) for k in estimate]
    logged = {
        k: SimpleNamespace(
            keyframe=SimpleNamespace(observations=None, relative=None, odometry=None),
            estimate=SimpleNamespace(map_T_rover=pose),
        )
        for k, pose in first.items()
    }
    again = Localisation(CAMERA, level_rover_T_camera(), whole.adjustment.orbital)
    again._dense = Ground(world[0], world[3])
    again.restore(frames, logged, entries, RectificationError())
    for name in ("_stations", "_driven_m", "_next_try_m", "_tried"):
        assert getattr(again._stations, name) == getattr(whole._stations, name), name
    assert set(again.terrain.frames) >= set(whole._stations.frames)
    assert not set(again.terrain.frames) & set(range(20))  # what a fix has used is not read
