"""The root command gathers what is installed and says what is missing."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import EntryPoint, version
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from bathyscope import cli, engines
from bathyscope.errors import BathyscopeError, ClipError, SettingsError

toy = typer.Typer()


@toy.command()
def greet(name: str) -> None:
    """Say a name, or fail as a bad clip does."""
    if name == "broken.mp4":
        raise ClipError("broken.mp4: no video stream")
    typer.echo(f"hello {name}")


def install(monkeypatch: pytest.MonkeyPatch, module: Any, **targets: str) -> None:
    def found(group: str, name: str | None = None) -> list[EntryPoint]:
        return [EntryPoint(key, value, group) for key, value in targets.items() if name in (None, key)]

    monkeypatch.setattr(module, "entry_points", found)


def test_the_version_is_the_installed_one() -> None:
    assert CliRunner().invoke(cli.root, ["--version"]).stdout.strip() == version("bathyscope")


def test_help_names_every_installed_command_without_importing_it(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, cli, depth="no_such_package:app", other="no_such_package:app")
    result = CliRunner().invoke(cli.root, ["--help"])
    assert result.exit_code == 0
    assert "depth" in result.stdout
    assert "other" in result.stdout


def test_a_sub_command_of_another_package_runs_with_its_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "toy_package", sys.modules[__name__])
    install(monkeypatch, cli, greet="toy_package:toy")
    assert CliRunner().invoke(cli.root, ["greet", "Ada"]).stdout == "hello Ada\n"


@pytest.mark.parametrize(
    ("package", "extra"),
    [("bathyscope_train", "train"), ("bathyscope_serve", "serve"), ("bathyscope_client", "client")],
)
def test_a_missing_requirement_names_the_extra_that_brings_it(
    monkeypatch: pytest.MonkeyPatch, package: str, extra: str
) -> None:
    install(monkeypatch, cli, thing=f"{package}.no_such_module:app")
    result = CliRunner().invoke(cli.root, ["thing"])
    assert result.exit_code == 2
    assert f"pip install 'bathyscope[{extra}]'" in result.output


def test_an_unknown_command_is_wrong_usage() -> None:
    assert CliRunner().invoke(cli.root, ["fly"]).exit_code == 2


def test_an_error_that_the_user_can_mend_is_one_line_and_code_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "toy_package", sys.modules[__name__])
    install(monkeypatch, cli, greet="toy_package:toy")
    monkeypatch.setattr(sys, "argv", ["bathyscope", "greet", "broken.mp4"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert capsys.readouterr().err == "bathyscope: broken.mp4: no video stream\n"


def test_the_package_runs_as_a_module() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "bathyscope", "--version"], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == version("bathyscope")


def test_an_engine_is_found_by_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "toy_package", sys.modules[__name__])
    install(monkeypatch, engines, onnx="toy_package:greet")
    factory: Any = engines.engine_factory()
    assert factory is greet


@pytest.mark.parametrize("targets", [{}, {"onnx": "no_such_package:Engine"}], ids=["none", "broken"])
def test_without_an_engine_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, targets: dict[str, str]
) -> None:
    install(monkeypatch, engines, **targets)
    with pytest.raises(SettingsError, match=r"engine 'onnx'.*pip install 'bathyscope\[serve\]'") as caught:
        engines.engine_factory()
    assert isinstance(caught.value, BathyscopeError)
