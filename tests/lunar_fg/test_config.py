"""Settings that a user wrote stay readable, or it is said what to change."""

import pytest

from frontends.errors import InputError
from lunar_fg.config import Config, read_config


def test_a_correlation_written_where_it_used_to_be_holds_for_the_graph(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("relative: {landmark_correlation: 0.01, min_inliers: 20}\n")
    config = read_config(path)
    assert config.graph.landmark_correlation == 0.01
    assert config.relative.min_inliers == 20
    again = Config.model_validate_json(config.model_dump_json())
    assert again == config
    path.write_text(f"{path.read_text()}graph: {{landmark_correlation: 0.02}}\n")
    with pytest.raises(InputError, match=r"relative\.landmark_correlation is graph\."):
        read_config(path)
    path.write_text("relative: {landmark_correlation: 7}\n")
    with pytest.raises(InputError, match="less than"):
        read_config(path)


def test_settings_of_fixes_that_are_gone_are_read_at_their_old_defaults_only(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("absolute: {inflation: 1.8, floor_pixels: 0.1, false_alarm: 1.0e-6}\n")
    config = read_config(path)
    assert config.absolute == Config(absolute={"false_alarm": 1e-6}).absolute
    path.write_text("absolute: {inflation: 3.0}\n")
    with pytest.raises(InputError, match="inflation"):
        read_config(path)
