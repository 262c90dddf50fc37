"""Loading weights: our own files, the published formats, and files that mean harm."""

from __future__ import annotations

import json
import os
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import TypeAdapter
from safetensors.torch import save_file
from torch import Tensor

from bathyscope.bundle import Bundle, shipped_bundle
from bathyscope.errors import CheckpointError
from bathyscope_train.model import Network, NetworkPreset
from bathyscope_train.model.checkpoints import (
    CheckpointPath,
    load_network,
    load_weights,
    save_checkpoint,
    shipped_checkpoint,
    training_of,
)
from bathyscope_train.model.half_precision import round_to_bfloat16
from bathyscope_train.model.presets import AggregatorSettings, DptSettings, IterativeCameraSettings, VitSettings

SMALL = NetworkPreset(
    name="small",
    stem=VitSettings(depth=1, heads=2, grid=3),
    aggregator=AggregatorSettings(width=16, depth=4, heads=2, taps=(0, 1, 2, 3)),
    camera=IterativeCameraSettings(depth=1, heads=2),
    depth=DptSettings(features=8, channels=(4, 4, 8, 8), hidden=4),
    gaussians=DptSettings(features=8, channels=(4, 4, 8, 8), hidden=4),
    harmonic_degree=1,
)


def random_network(seed: int = 0) -> Network:
    torch.manual_seed(seed)
    return Network(SMALL).eval()


def test_a_rounded_network_fits_into_half_the_file_and_comes_back_as_it_was(tmp_path: Path) -> None:
    network = random_network()
    round_to_bfloat16(network)
    save_checkpoint(network, tmp_path / "whole.safetensors")
    save_checkpoint(network, tmp_path / "half.safetensors", half=True)
    loaded, report = load_network(tmp_path / "half.safetensors")
    assert report.complete
    assert_equal_weights(loaded, network.state_dict())
    whole, half = ((tmp_path / f"{name}.safetensors").stat().st_size for name in ("whole", "half"))
    assert half < 0.7 * whole  # the rest are vectors and names


def test_what_does_not_fit_stays_whole(tmp_path: Path) -> None:
    network = random_network()
    save_checkpoint(network, tmp_path / "half.safetensors", half=True)
    assert_equal_weights(load_network(tmp_path / "half.safetensors")[0], network.state_dict())


def published(network: Network, prefix: str) -> dict[str, Tensor]:
    """Named, and with the aggregator in half precision, like the published files."""
    return {
        prefix + key: value.to(torch.bfloat16) if key.startswith("aggregator.") else value.clone()
        for key, value in network.state_dict().items()
    }


def assert_equal_weights(observed: Network, expected: dict[str, Tensor], prefix: str = "") -> None:
    for key, value in observed.state_dict().items():
        assert value.dtype == torch.float32
        torch.testing.assert_close(value, expected[prefix + key].float(), rtol=0, atol=0)


def test_own_checkpoint_says_what_it_is_and_gives_back_the_same_network(tmp_path: Path) -> None:
    network = random_network()
    save_checkpoint(network, tmp_path / "a.safetensors", training={"steps": 3, "data": "synthetic"})
    loaded, report = load_network(tmp_path / "a.safetensors")
    assert report.complete
    assert loaded.preset == SMALL
    assert_equal_weights(loaded, network.state_dict())
    assert training_of(tmp_path / "a.safetensors") == {"steps": 3, "data": "synthetic"}
    assert [path.name for path in tmp_path.iterdir()] == ["a.safetensors"]


@pytest.mark.parametrize("prefix", ["", "encoder.", "model.encoder.", "module.", "module.model.encoder."])
@pytest.mark.parametrize("kind", ["safetensors", "torch"])
def test_published_formats_load_whatever_their_prefix(tmp_path: Path, prefix: str, kind: str) -> None:
    weights = published(random_network(), prefix)
    path = tmp_path / "weights"
    if kind == "safetensors":
        save_file(weights, path)
    else:
        torch.save(weights, path)
    loaded, report = load_network(path, SMALL)
    assert report.complete, report
    assert_equal_weights(loaded, weights, prefix)


@pytest.mark.parametrize("key", ["state_dict", "model"])
def test_training_loops_wrapping_is_taken_off(tmp_path: Path, key: str) -> None:
    weights = published(random_network(), "model.encoder.")
    torch.save({"epoch": 7, "optimizer": {"lr": 1e-3}, key: weights}, tmp_path / "last.ckpt")
    network = random_network(seed=1)
    assert load_weights(network, tmp_path / "last.ckpt").complete
    assert_equal_weights(network, weights, "model.encoder.")


def test_teacher_copies_and_foreign_heads_are_ignored_and_named(tmp_path: Path) -> None:
    weights = published(random_network(), "encoder.")
    extra = ["encoder.distill_aggregator.camera_token", "point_head.norm.weight", "track_head.norm.weight"]
    save_file(weights | {key: torch.zeros(2) for key in extra}, tmp_path / "a")
    _, report = load_network(tmp_path / "a", SMALL)
    assert set(report.ignored) == set(extra)
    assert report.complete


def test_missing_unexpected_and_misshapen_keys_are_reported_and_nothing_else_changes(tmp_path: Path) -> None:
    network, original = random_network(seed=1), random_network(seed=1).state_dict()
    weights = {k: v for k, v in published(random_network(), "").items() if not k.startswith("gaussian_param_head.")}
    weights["camera_head.token_norm.weight"] = torch.zeros(5)
    weights["depth_head.norm.bias"] = torch.zeros(32, dtype=torch.int64)
    weights["camera_head.new_part.weight"] = torch.zeros(3)
    save_file(weights, tmp_path / "a")
    report = load_weights(network, tmp_path / "a")
    gaussian_keys = {key for key in original if key.startswith("gaussian_param_head.")}
    assert set(report.missing) == gaussian_keys
    assert report.unexpected == ("camera_head.new_part.weight",)
    assert sorted(report.mismatched) == [
        "camera_head.token_norm.weight: 5, needed 32",
        "depth_head.norm.bias: torch.int64, needed torch.float32",
    ]
    assert not report.complete
    kept = gaussian_keys | {"camera_head.token_norm.weight", "depth_head.norm.bias"}
    for key, value in network.state_dict().items():
        torch.testing.assert_close(value, original[key] if key in kept else weights[key].float(), rtol=0, atol=0)


def test_two_keys_that_mean_the_same_parameter_are_refused(tmp_path: Path) -> None:
    weights = published(random_network(), "")
    save_file(weights | {"encoder.aggregator.camera_token": torch.zeros(1, 2, 1, 16)}, tmp_path / "a")
    with pytest.raises(CheckpointError, match=r"both aggregator\.camera_token and encoder\.aggregator\.camera_token"):
        load_network(tmp_path / "a", SMALL)


def test_values_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    weights = published(random_network(), "")
    weights["depth_head.norm.weight"][3] = float("nan")
    save_file(weights, tmp_path / "a")
    with pytest.raises(CheckpointError, match=r"depth_head\.norm\.weight holds values that are not finite"):
        load_network(tmp_path / "a", SMALL)


def test_a_file_without_a_preset_needs_one_and_a_file_with_one_refuses_another(tmp_path: Path) -> None:
    save_file(published(random_network(), ""), tmp_path / "published")
    save_checkpoint(random_network(), tmp_path / "own")
    with pytest.raises(CheckpointError, match="name a preset"):
        load_network(tmp_path / "published")
    with pytest.raises(CheckpointError, match="says itself that it is a 'small'"):
        load_network(tmp_path / "own", SMALL)


class Harmful:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


def test_pickled_code_is_refused_and_not_run(tmp_path: Path) -> None:
    torch.save({"a": torch.zeros(1), "b": Harmful(tmp_path / "ran")}, tmp_path / "bad.pt")
    with pytest.raises(CheckpointError, match="could run code"):
        load_network(tmp_path / "bad.pt", SMALL)
    assert not (tmp_path / "ran").exists()


def safetensors_file(path: Path, header: bytes, length: int | None = None, body: bytes = b"") -> None:
    path.write_bytes(struct.pack("<Q", len(header) if length is None else length) + header + body)


def write_broken(path: Path, kind: str) -> None:
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("these are not weights")
    elif kind == "a zip of something else":
        with zipfile.ZipFile(path, "w") as target:
            target.writestr("readme.txt", "hello")
    elif "torch" in kind or kind in ("no tensors", "bare pickle"):
        write_broken_torch(path, kind)
    else:
        write_broken_safetensors(path, kind)


def write_broken_safetensors(path: Path, kind: str) -> None:
    header = json.dumps({"x": {"dtype": "F32", "shape": [4], "data_offsets": [0, 16]}}).encode()
    if kind == "truncated safetensors":
        whole = path.with_name("whole")
        save_file(published(random_network(), ""), whole)
        path.write_bytes(whole.read_bytes()[:-100])
    elif kind == "header longer than the file":
        safetensors_file(path, header, length=1 << 60)
    elif kind == "header is not JSON":
        safetensors_file(path, b"{" + b"\xff" * 40)
    elif kind == "offsets beyond the end":
        safetensors_file(path, header.replace(b"16]", b"99]"), body=bytes(16))
    elif kind == "shape larger than its bytes":
        safetensors_file(path, header.replace(b"[4]", b"[4000000000, 4000000000]"), body=bytes(16))


def write_broken_torch(path: Path, kind: str) -> None:
    whole = path.with_name("whole")
    if kind == "truncated torch file":
        torch.save(published(random_network(), ""), whole)
        path.write_bytes(whole.read_bytes()[:-1000])
    elif kind == "compressed torch file":
        torch.save(published(random_network(), ""), whole)
        with zipfile.ZipFile(whole) as source, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
            for name in source.namelist():
                target.writestr(name, source.read(name))
    elif kind == "no tensors":
        torch.save({"epoch": 3}, path)
    elif kind == "bare pickle":
        path.write_bytes(pickle.dumps({"a": 1}, protocol=2))


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("empty", "neither safetensors nor"),
        ("text", "neither safetensors nor"),
        ("truncated safetensors", "damaged safetensors"),
        ("header longer than the file", "damaged safetensors"),
        ("header is not JSON", "damaged safetensors"),
        ("offsets beyond the end", "damaged safetensors"),
        ("shape larger than its bytes", "damaged safetensors"),
        ("truncated torch file", "truncated or damaged"),
        ("compressed torch file", "is compressed"),
        ("a zip of something else", "not a PyTorch checkpoint"),
        ("no tensors", "no tensors in it"),
        ("bare pickle", "before version 1.6"),
    ],
)
def test_damaged_and_foreign_files_are_refused_by_name(tmp_path: Path, kind: str, message: str) -> None:
    path = tmp_path / "broken"
    write_broken(path, kind)
    with pytest.raises(CheckpointError, match=f"broken: .*{message}"):
        load_network(path, SMALL)


def test_a_flipped_byte_in_a_torch_files_pickle_is_an_error_and_no_crash(tmp_path: Path) -> None:
    torch.save(published(random_network(), ""), tmp_path / "whole")
    content = (tmp_path / "whole").read_bytes()
    start = content.index(b"data.pkl")
    path = tmp_path / "broken"
    refused = 0
    for offset in range(start + 20, start + 900, 40):
        path.write_bytes(content[:offset] + bytes([content[offset] ^ 0xFF]) + content[offset + 1 :])
        try:
            load_network(path, SMALL)
        except CheckpointError:
            refused += 1
    assert refused > 10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"harmonic_degree": 2}, "does not hold the 'small' network it names"),
        ({"patch_size": -1}, "its preset cannot be used: patch_size"),
        ({"aggregator": {"depth": 10**9, "taps": [0, 1, 2, 3]}}, "its preset cannot be used: aggregator"),
    ],
)
def test_a_checkpoint_whose_preset_does_not_fit_is_refused(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    preset = json.dumps(SMALL.model_dump(mode="json") | change)
    tensors = {key: value.contiguous() for key, value in random_network().state_dict().items()}
    save_file(tensors, tmp_path / "a", metadata={"bathyscope.preset": preset})
    with pytest.raises(CheckpointError, match=message):
        load_network(tmp_path / "a")


def test_settings_may_name_the_shipped_checkpoint() -> None:
    wanted = TypeAdapter(CheckpointPath)
    assert wanted.validate_python("shipped") == shipped_checkpoint()
    assert wanted.validate_python("other.safetensors") == Path("other.safetensors")


def test_the_shipped_checkpoint_is_that_of_the_shipped_bundle() -> None:
    network, report = load_network(shipped_checkpoint())
    assert report.complete
    assert network.preset.name == "tiny-lite0"
    bundle = Bundle.open(shipped_bundle())
    assert training_of(shipped_checkpoint()) == bundle.manifest.training
    weights = (bundle.folder / "weights.bin").read_bytes()
    kernel = network.state_dict()["aggregator.patch_embed.to_half.0.weight"].to(torch.bfloat16)
    assert kernel.view(torch.int16).numpy().tobytes() in weights
