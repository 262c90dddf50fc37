"""Opening a bundle: a good one, and everything that an untrusted one may try."""

from __future__ import annotations

import gc
import json
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from onnx import TensorProto, helper

import bathyscope.bundle as bundle_module
from bathyscope.bundle import (
    BUNDLE_FORMAT,
    Bundle,
    BundleManifest,
    FileEntry,
    GraphSpec,
    hash_file,
    shipped_bundle,
    write_manifest,
)
from bathyscope.errors import BundleError
from bathyscope.model_spec import InputSpec, SceneSpec

GRAPHS = {"backbone": "backbone.onnx", "heads": "heads.onnx", "cameras": "cameras.onnx"}


def onnx_bytes(location: str | None) -> bytes:
    weights = []
    if location is not None:
        tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[2], data_location=TensorProto.EXTERNAL)
        tensor.external_data.add(key="location", value=location)
        weights.append(tensor)
    graph = helper.make_graph([], "g", [], [], initializer=weights)
    return bytes(helper.make_model(graph).SerializeToString())


def write_bundle(folder: Path, location: str | None = "weights.bin") -> Path:
    folder.mkdir(parents=True)
    (folder / "weights.bin").write_bytes(bytes(8))
    (folder / "card.md").write_text("# A model\n")
    for name in GRAPHS.values():
        (folder / name).write_bytes(onnx_bytes(location if name == "backbone.onnx" else "weights.bin"))
    names = ("weights.bin", "card.md", *GRAPHS.values())
    write_manifest(
        folder,
        BundleManifest(
            name="toy",
            version="1.2",
            preset="tiny",
            graphs={role: GraphSpec(file=name, inputs=("images",), outputs=("x",)) for role, name in GRAPHS.items()},  # type: ignore[misc]
            weights="weights.bin",
            files={name: hash_file(folder / name) for name in names},
            input=InputSpec(patch=14, pixels=224 * 280, window=16, overlap=4),
            scene=SceneSpec(pixel_centre=0.5, focal_epsilon=0.0, activation="footprint", sh_degree=1),
            licence="Apache-2.0",
            research_only=False,
        ),
    )
    return folder


def zip_bundle(folder: Path, path: Path, **extra: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.iterdir()):
            archive.write(file, file.name)
        for name, data in extra.items():
            archive.writestr(name, data)
    return path


def edit(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    manifest = json.loads((folder / "bundle.json").read_text())
    change(manifest)
    (folder / "bundle.json").write_text(json.dumps(manifest))


def unpacked_bundles() -> set[Path]:
    return set(Path(tempfile.gettempdir()).glob("bathyscope-bundle-*"))


@pytest.fixture(autouse=True)
def _own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "temp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temp"))


def test_a_bundle_folder_opens_with_its_manifest_and_paths(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path / "toy")
    bundle = Bundle.open(folder)
    assert (bundle.id.name, bundle.id.version) == ("toy", "1.2")
    assert bundle.graph("heads") == folder / "heads.onnx"
    assert bundle.manifest.input.window == 16


def test_the_digest_of_a_zip_is_that_of_its_folder_and_changes_with_the_manifest(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path / "toy")
    first = Bundle.open(folder).id.digest
    assert Bundle.open(zip_bundle(folder, tmp_path / "toy.zip")).id.digest == first
    edit(folder, lambda manifest: manifest.update(version="1.3"))
    assert Bundle.open(folder).id.digest != first


def test_a_zip_is_unpacked_while_its_bundle_lives_and_removed_afterwards(tmp_path: Path) -> None:
    bundle = Bundle.open(zip_bundle(write_bundle(tmp_path / "toy"), tmp_path / "toy.zip"))
    assert (bundle.folder / "weights.bin").is_file()
    assert unpacked_bundles() == {bundle.folder}
    del bundle
    gc.collect()
    assert unpacked_bundles() == set()


def change_a_byte(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[-1] ^= 1
        (folder / name).write_bytes(data)

    return change


def rename_weights(name: str) -> Callable[[Path], None]:
    """The manifest names other weights, and lists them."""

    def change(manifest: dict[str, Any]) -> None:
        manifest["weights"] = name
        manifest["files"][name] = manifest["files"].pop("weights.bin")

    return lambda folder: edit(folder, change)


def link(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        target = folder.parent / f"outside-{name}"
        (folder / name).rename(target)
        (folder / name).symlink_to(target)

    return change


def put(**fields: Any) -> Callable[[Path], None]:
    return lambda folder: edit(folder, lambda manifest: manifest.update(fields))


def without(*keys: str) -> Callable[[Path], None]:
    def change(manifest: dict[str, Any]) -> None:
        for key in keys[:-1]:
            manifest = manifest[key]
        del manifest[keys[-1]]

    return lambda folder: edit(folder, change)


def put_inside(*keys: str, value: Any) -> Callable[[Path], None]:
    def change(manifest: dict[str, Any]) -> None:
        for key in keys[:-1]:
            manifest = manifest[key]
        manifest[keys[-1]] = value

    return lambda folder: edit(folder, change)


def folder_for_the_card(folder: Path) -> None:
    (folder / "card.md").unlink()
    (folder / "card.md").mkdir()


def overwrite(name: str, data: bytes) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return change


WRONG: dict[str, tuple[Callable[[Path], None], str]] = {
    "changed weights": (change_a_byte("weights.bin"), r"weights\.bin was changed"),
    "changed graph": (change_a_byte("heads.onnx"), r"heads\.onnx was changed"),
    "longer weights": (overwrite("weights.bin", bytes(9)), r"has 9 bytes, .* says 8"),
    "missing weights": (lambda f: (f / "weights.bin").unlink(), r"weights\.bin is missing"),
    "folder for a file": (folder_for_the_card, r"card\.md is missing"),
    "stranger": (overwrite("evil.so", b""), r"\['evil\.so'\] lie in the bundle"),
    "folder inside": (lambda f: (f / "more").mkdir(), r"\['more'\] lie in the bundle"),
    "linked weights": (link("weights.bin"), r"weights\.bin is a link"),
    "linked graph": (link("backbone.onnx"), r"backbone\.onnx is a link"),
    "linked manifest": (link("bundle.json"), r"no bundle\.json"),
    "no manifest": (lambda f: (f / "bundle.json").unlink(), r"no bundle\.json"),
    "weights above": (rename_weights("../weights.bin"), r"'\.\./weights\.bin' is not a plain name"),
    "weights at a root": (rename_weights("/etc/passwd"), r"'/etc/passwd' is not a plain name"),
    "weights in a folder": (rename_weights("more/weights.bin"), r"not a plain name"),
    "weights behind a backslash": (rename_weights("..\\weights.bin"), r"not a plain name"),
    "hidden weights": (rename_weights(".weights"), r"not a plain name"),
    "nameless weights": (rename_weights(""), r"not a plain name"),
    "name with a zero": (rename_weights("weights\0.bin"), r"not a plain name"),
    "name with a newline": (rename_weights("weights.bin\n"), r"not a plain name"),
    "unlisted weights": (put(weights="other.bin"), r"\['other\.bin'\] are used but have no entry"),
    "unlisted graph": (put_inside("graphs", "heads", "file", value="../x.onnx"), r"\['\.\./x\.onnx'\] are used"),
    "no camera graph": (without("graphs", "cameras"), r"graphs \['cameras'\] are missing"),
    "unknown graph": (put_inside("graphs", "extra", value={}), r"bundle\.json cannot be used"),
    "newer format": (put(format=BUNDLE_FORMAT + 1), r"newer than this build reads .*upgrade bathyscope"),
    "unknown field": (put(plugin="evil.py"), r"plugin: Extra inputs are not permitted"),
    "no licence": (without("licence"), r"licence: Field required"),
    "bad hash": (put_inside("files", "card.md", "sha256", value="ABC"), r"files\.card\.md\.sha256"),
    "negative size": (put_inside("files", "card.md", "bytes", value=-1), r"files\.card\.md\.bytes"),
    "windows that stand still": (put_inside("input", "overlap", value=16), r"overlap \(16\) must be smaller"),
    "unknown activation": (put_inside("scene", "activation", value="exec"), r"scene\.activation"),
    "text for a manifest": (overwrite("bundle.json", b"hello"), r"Invalid JSON"),
    "binary manifest": (overwrite("bundle.json", b"\xff\xfe{}"), r"bundle\.json cannot"),
    "manifest too long": (overwrite("bundle.json", b" " * ((1 << 20) + 1)), r"bundle\.json has 1048577 bytes"),
    "more than a bundle may hold": (put_inside("files", "card.md", "bytes", value=1 << 50), r"at most \d+ are read"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG)
def test_a_folder_that_was_tampered_with_is_refused(
    tmp_path: Path, change: Callable[[Path], None], message: str
) -> None:
    folder = write_bundle(tmp_path / "toy")
    change(folder)
    with pytest.raises(BundleError, match=message) as caught:
        Bundle.open(folder)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize(
    "location", ["../weights.bin", "/etc/passwd", "other.bin", "./weights.bin", "", "card.md", "weights.bin\0"]
)
def test_graphs_may_read_no_file_but_the_weights(tmp_path: Path, location: str) -> None:
    folder = write_bundle(tmp_path / "toy", location)
    with pytest.raises(BundleError, match=r"backbone\.onnx reads weights from .*only 'weights\.bin' is allowed"):
        Bundle.open(folder)


def test_a_graph_may_do_without_weights(tmp_path: Path) -> None:
    assert Bundle.open(write_bundle(tmp_path / "toy", location=None)).manifest.name == "toy"


def test_a_graph_that_is_no_onnx_is_refused(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path / "toy")
    (folder / "heads.onnx").write_bytes(b"no graph")
    entry = hash_file(folder / "heads.onnx").model_dump()
    edit(folder, lambda manifest: manifest["files"].update({"heads.onnx": entry}))
    with pytest.raises(BundleError, match=r"heads\.onnx: not an ONNX graph"):
        Bundle.open(folder)


def test_a_graph_larger_than_any_graph_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle_module, "MAX_GRAPH_BYTES", 10)
    with pytest.raises(BundleError, match=r"graph \w+\.onnx has \d+ bytes; at most 10"):
        Bundle.open(write_bundle(tmp_path / "toy"))


@pytest.mark.parametrize(
    "name", ["../evil", "/evil", "more/evil", "..\\evil", "C:evil", ".evil", "a" * 129], ids=lambda name: name[:12]
)
def test_a_zip_with_a_path_in_it_is_refused_and_leaves_nothing(tmp_path: Path, name: str) -> None:
    path = zip_bundle(write_bundle(tmp_path / "toy"), tmp_path / "toy.zip", **{name: b"x"})
    with pytest.raises(BundleError, match="not a plain file name"):
        Bundle.open(path)
    assert unpacked_bundles() == set()
    assert not list(tmp_path.rglob("evil"))


def test_a_zip_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = zip_bundle(write_bundle(tmp_path / "toy"), tmp_path / "toy.zip", big=bytes(1 << 20))
    monkeypatch.setattr(bundle_module, "MAX_BUNDLE_BYTES", 1 << 19)
    with pytest.raises(BundleError, match=r"toy\.zip: unpacks to more than 524288 bytes"):
        Bundle.open(path)
    assert unpacked_bundles() == set()


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_zip_with_a_name_twice_is_refused(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path / "toy")
    path = zip_bundle(folder, tmp_path / "toy.zip")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("card.md", "another card")
    with pytest.raises(BundleError, match=r"toy\.zip"):
        Bundle.open(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_no_damage_to_a_zip_does_worse_than_a_bundle_error(tmp_path: Path, method: int) -> None:
    """Any one byte changed: the bundle opens as it was (the byte did not matter), or is refused."""
    folder = write_bundle(tmp_path / "toy")
    path = tmp_path / "toy.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        for file in sorted(folder.iterdir()):
            archive.write(file, file.name)
    whole = path.read_bytes()
    digest = Bundle.open(path).id.digest
    refused = 0
    for position in range(0, len(whole), 13):
        data = bytearray(whole)
        data[position] ^= 0xFF
        path.write_bytes(data)
        try:
            assert Bundle.open(path).id.digest == digest
        except BundleError:
            refused += 1
    assert refused > 0.5 * len(range(0, len(whole), 13))
    gc.collect()
    assert unpacked_bundles() == set()


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04", b"a text"], ids=["empty", "cut", "text"])
def test_a_file_that_is_no_zip_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "toy.zip").write_bytes(data)
    with pytest.raises(BundleError, match="neither a bundle folder nor a readable"):
        Bundle.open(tmp_path / "toy.zip")


def test_a_path_that_is_not_there_says_what_to_give(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match=r"nowhere: no such bundle; give a folder with bundle\.json"):
        Bundle.open(tmp_path / "nowhere")


def test_hashes_are_sha256_of_the_content(tmp_path: Path) -> None:
    (tmp_path / "abc").write_bytes(b"abc")
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert hash_file(tmp_path / "abc") == FileEntry(sha256=expected, bytes=3)


def test_a_manifest_is_written_whole_and_reads_back_the_same(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path / "toy")
    manifest = Bundle.open(folder).manifest
    write_manifest(folder, manifest)
    assert Bundle.open(folder).manifest == manifest
    assert not list(folder.glob("*.part"))


def test_an_installation_without_a_bundle_says_how_to_give_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bundle_module, "__file__", str(tmp_path / "bundle.py"))
    with pytest.raises(BundleError, match=r"no shipped bundle .* give one with --bundle"):
        shipped_bundle()
