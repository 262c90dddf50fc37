"""The container image and the compose file, checked without a container engine."""

import json
import os
import shlex
import shutil
import subprocess
import tomllib
import venv
from pathlib import Path

import httpx
import pytest
import yaml
from dockerfile import Instruction, environment, read_stages

from bathyscope_client.demo import running_service
from bathyscope_serve.settings import ServiceSettings

ROOT = Path(__file__).parents[2]
BUILD, FINAL = read_stages(ROOT / "serve" / "Dockerfile")
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICE = COMPOSE["services"]["depth"]


def values(stage: list[Instruction], name: str) -> list[str]:
    return [instruction.value for instruction in stage if instruction.name == name]


def test_the_image_is_small_in_kind() -> None:
    assert all(value.startswith("python:3.11-slim") for value in values(BUILD, "FROM") + values(FINAL, "FROM"))
    copied = " ".join(values(FINAL, "COPY"))
    assert copied == "--from=build /opt/bathyscope /opt/bathyscope", "no source and no tools in the final stage"
    assert environment(BUILD)["PIP_NO_CACHE_DIR"] == "1"


def test_it_installs_an_extra_of_this_project_that_never_asks_for_torch() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    (install,) = [value for value in values(BUILD, "RUN") if "pip install" in value]
    assert install.endswith("'.[serve]'")
    assert "--constraint constraints.txt" in install
    names, todo = set[str](), list(extras["serve"])
    while todo:
        requirement = todo.pop()
        if requirement.startswith("bathyscope["):
            todo += extras[requirement.removeprefix("bathyscope[").removesuffix("]")]
        names.add(requirement.split(">")[0].split("[")[0])
    assert not names & {"torch", "onnx", "jaxtyping", "tensorboard", "pytest"}
    assert "onnxruntime" in names


def test_every_file_the_build_copies_exists_and_is_let_through() -> None:
    let_through = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    sources = [word for value in values(BUILD, "COPY") for word in shlex.split(value)[:-1]]
    assert set(sources) == let_through
    assert all((ROOT / source).exists() for source in sources)


def test_it_runs_without_rights() -> None:
    (user,) = values(FINAL, "USER")
    assert user.split(":")[0].isdecimal()
    assert int(user.split(":")[0]) > 0
    assert FINAL.index(Instruction("USER", user)) > max(i for i, step in enumerate(FINAL) if step.name == "RUN")


def test_entry_point_and_health_check_are_programs_not_shell_lines() -> None:
    assert json.loads(values(FINAL, "ENTRYPOINT")[0]) == ["bathyscope", "serve"]
    (check,) = values(FINAL, "HEALTHCHECK")
    program = json.loads(check.split("CMD", 1)[1])
    assert program[0] == "python"
    compile(program[2], "health check", "exec")


def test_every_setting_of_image_and_compose_file_is_one_of_the_service() -> None:
    given = {**environment(FINAL), **SERVICE["environment"]}
    settings = {name.removeprefix("BATHYSCOPE_").lower(): v for name, v in given.items() if name.startswith("BATHY")}
    assert set(settings) <= set(ServiceSettings.model_fields)
    ServiceSettings.read(**settings)


def test_compose_confines_the_service_and_keeps_what_it_must_write_writable() -> None:
    assert SERVICE["build"]["dockerfile"] == "serve/Dockerfile"
    assert SERVICE["read_only"] is True
    assert SERVICE["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in SERVICE["security_opt"]
    writable = {entry.split(":")[0] for entry in SERVICE["tmpfs"]}
    writable |= {entry.split(":")[1] for entry in SERVICE["volumes"]}
    final = environment(FINAL)
    assert {final["BATHYSCOPE_TEMP"], final["NUMBA_CACHE_DIR"]} == writable


def test_compose_publishes_the_port_of_the_image_on_this_machine_only() -> None:
    (port,) = SERVICE["ports"]
    address, _, inside = port.split(":")
    assert (address, inside) == ("127.0.0.1", environment(FINAL)["BATHYSCOPE_PORT"])
    assert values(FINAL, "EXPOSE") == [inside]


def test_compose_waits_longer_than_the_service_drains() -> None:
    assert int(SERVICE["stop_grace_period"].removesuffix("s")) > ServiceSettings().drain_timeout_s


@pytest.mark.skipif(shutil.which("docker-compose") is None, reason="docker-compose is not installed")
def test_compose_accepts_the_file() -> None:
    done = subprocess.run(
        ["docker-compose", "config", "--quiet"], cwd=ROOT, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.skipif(
    os.environ.get("BATHYSCOPE_REPLAY_IMAGE") != "1",
    reason="installs the service from the package index; set BATHYSCOPE_REPLAY_IMAGE=1",
)
def test_the_steps_of_the_image_give_a_service_that_is_healthy(tmp_path: Path) -> None:
    source, target = tmp_path / "src", tmp_path / "opt"
    source.mkdir()
    for name in (word for value in values(BUILD, "COPY") for word in shlex.split(value)[:-1]):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, source / name)
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "BATHYSCOPE"))}
    venv.create(tmp_path / "base", with_pip=True)
    plain["PATH"] = f"{tmp_path / 'base' / 'bin'}:{plain['PATH']}"
    for step in values(BUILD, "RUN"):
        command = step.replace("/opt/bathyscope", str(target))
        subprocess.run(["sh", "-euc", command], cwd=source, env=plain | environment(BUILD), check=True)
    python = target / "bin" / "python"
    listed = subprocess.run([python, "-m", "pip", "list"], capture_output=True, text=True, check=True).stdout
    assert "torch" not in listed
    (tmp_path / "run.log").touch()
    with running_service(tmp_path / "run.log", 300, (str(target / "bin" / "bathyscope"),)) as url:
        check = json.loads(values(FINAL, "HEALTHCHECK")[0].split("CMD", 1)[1])
        port = url.rsplit(":", 1)[1]
        subprocess.run([python, *check[1:]], env={"BATHYSCOPE_PORT": port}, check=True)
        assert httpx.get(f"{url}/bundle", trust_env=False).is_success


def test_the_document_lists_every_setting_with_its_default() -> None:
    text = (ROOT / "docs" / "service.md").read_text().split("## Settings")[1]
    rows = [[cell.strip() for cell in line.split("|")[1:3]] for line in text.splitlines() if line.startswith("| `")]
    documented = {
        name.strip("` "): default.strip()
        for names, defaults in rows
        for name, default in zip(names.split(","), defaults.split(",") * len(names.split(",")), strict=False)
    }
    assert set(documented) == set(ServiceSettings.model_fields)
    numbers = {name: float(default) for name, default in documented.items() if default.isdecimal()}
    fields = ServiceSettings.model_fields
    assert numbers == {name: field.default for name, field in fields.items() if isinstance(field.default, int | float)}
