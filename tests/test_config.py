"""Settings: presets, files, --set, and what is printed."""

import dataclasses
import tomllib
from functools import partial

import pytest
import tomli_w

from sonarrec import config
from sonarrec.errors import UsageError
from sonarrec.tables.toml import checked, types_of
from tests.support.command import sonarrec


@pytest.mark.parametrize("name", list(config.PRESETS))
def test_printed_toml_reads_back_as_the_same_configuration(name, tmp_path):
    settings = dataclasses.replace(config.preset(name), seed=7)
    file = tmp_path / "my.toml"
    file.write_text(config.as_commented_toml(settings))
    assert tomllib.loads(file.read_text()) == dataclasses.asdict(settings)
    assert config.configs(path=file) == [settings]


@pytest.mark.parametrize("name", list(config.PRESETS))
def test_every_preset_is_within_what_the_paper_and_the_choices_allow(name):
    settings = config.preset(name)
    assert settings.preset == name
    if name == "paper":
        assert 1000 <= settings.continuity.particles <= 2000
    assert settings.continuity.spread_limit == 0.25
    assert settings.continuity.strikes == 5
    for section, kind in config.SECTIONS.items():
        for field in dataclasses.fields(kind):
            value = getattr(getattr(settings, section), field.name)
            assert type(value) is type(field.default)
            assert checked(value, types_of(kind)[field.name], field.name) == value


def test_the_paper_preset_takes_every_rule_as_published():
    paper = config.preset("paper")
    assert (paper.candidates.plane, paper.candidates.detector) == ("fan", "edge")
    assert paper.continuity.motion == "random_walk"
    assert paper.continuity.sigma_px == 10
    assert paper.continuity.min_existence == 0  # only the strikes delete
    assert paper.features.motion_model == "inverse_distance"
    assert paper.features.measurement == "single"
    assert paper.features.decide == "comparison"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("nonsense = 1", "nonsense"),
        ("[candidates]\nthreshhold = 0.3", "candidates.threshhold"),
        ('[candidates]\nplane = "sea"', "candidates.plane"),
        ("[continuity]\nparticles = 1000.5", "continuity.particles"),
        ("[continuity]\nsigma_px = -1", "continuity.sigma_px"),
        ("[continuity]\nparticles = 0", "continuity.particles"),
        ("[candidates]\nmin_visible = 0", "candidates.min_visible"),
        ("[candidates]\ndisc_radius_px = 0.5", "candidates.disc_radius_px"),
        ("features = 4", "features"),
        ("seed = -1", "seed"),
        ('preset = "best"', "best"),
        # By --set
        ("--set candidates.threshold", "stage.key=value"),
        ("--set threshold=0.3", "stage.key=value"),
        ("--set continuity.declare=.9", "continuity.declare"),
        ("--set candidate.threshold=0.3", "candidate"),
        ("--set candidates.threshold=high", "candidates.threshold"),
        ("--set continuity.particles=1e400", "continuity.particles"),
        ("--set features.motion_model=wheels", "features.motion_model"),
        ("--set preset.name=paper", "preset"),
        # Gone, with what to do: files of earlier versions have it, their run.toml too.
        ("[features]\nalike_radii = 0.3\n", "delete it"),
        ("[config.features]\nalike_radii = 0.3\n", "delete it"),
        ("--set features.alike_radii=0.3", "delete it"),
    ],
)
def test_what_is_no_setting_is_told_by_name(text, named, tmp_path):
    file = tmp_path / "my.toml"
    file.write_text(text)
    read = partial(config.configs, path=file)
    if text.startswith("--set "):
        read = partial(config.with_assignments, config.Config(), [text.removeprefix("--set ")])
    with pytest.raises(UsageError) as caught:
        read()
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", [".35", "0.35", " 3.5e-1", "+.35"])
def test_numbers_are_read_as_people_write_them(text):
    settings = config.with_assignments(config.Config(), [f"candidates.threshold={text}"])
    assert settings.candidates.threshold == 0.35


def test_texts_may_be_bare_or_quoted_and_the_last_assignment_wins():
    texts = ["features.motion_model=inverse_distance", 'candidates.plane = "fan"']
    settings = config.with_assignments(config.Config(), [*texts, "candidates.plane=floor"])
    assert settings.features.motion_model == "inverse_distance"
    assert settings.candidates.plane == "floor"


def printed(*arguments: str) -> dict:
    return tomllib.loads(sonarrec("config", *arguments).output)


def test_preset_then_file_then_set_then_seed(tmp_path):
    file = tmp_path / "my.toml"
    file.write_text(
        "seed = 3\n[candidates]\nthreshold = 0.11\nmin_visible = 0.22\n"
        "[features]\nmotion_model = 'association'\n"
    )
    table = printed("--preset", "paper", "--config", str(file), "--set", "candidates.threshold=0.5")
    paper = dataclasses.asdict(config.preset("paper"))
    assert (table["preset"], table["seed"]) == ("paper", 3)
    assert table["candidates"]["threshold"] == 0.5  # --set over the file
    assert table["candidates"]["min_visible"] == 0.22  # the file over the preset
    assert table["features"]["motion_model"] == "association"
    assert table["candidates"]["plane"] == paper["candidates"]["plane"]
    assert printed("--config", str(file), "--set", "seed=9")["seed"] == 9


def test_a_preset_named_in_the_file_serves_unless_the_flag_names_another(tmp_path):
    file = tmp_path / "my.toml"
    file.write_text('preset = "paper"\n')
    assert printed("--config", str(file)) == dataclasses.asdict(config.preset("paper"))
    assert printed("--config", str(file), "--preset", "default") == printed()


def test_the_configuration_is_printed_with_units_and_meanings():
    result = sonarrec("config")
    assert tomllib.loads(result.output) == dataclasses.asdict(config.preset("default"))
    for kind in config.SECTIONS.values():
        for field in dataclasses.fields(kind):
            assert f"\n{field.name} = " in result.output
            assert field.metadata["meaning"]
            assert field.metadata["meaning"] in result.output
            assert f"[{field.metadata['unit']}]" in result.output or not field.metadata["unit"]


def test_a_run_toml_is_a_settings_file_too(tmp_path):
    settings = config.with_assignments(config.preset("paper"), ["continuity.strikes=7"])
    file = tmp_path / "run.toml"
    table = {"finished": True, "input": {"name": "x"}, "config": dataclasses.asdict(settings)}
    file.write_text(tomli_w.dumps(table))
    assert printed("--config", str(file)) == dataclasses.asdict(settings)
