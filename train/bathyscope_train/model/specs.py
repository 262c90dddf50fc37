"""What a runtime must know of a network, said from its preset."""

from bathyscope.errors import SettingsError
from bathyscope.model_spec import InputSpec, ModelSpec, SceneSpec
from bathyscope_train.model.presets import NetworkPreset


def scene_spec(preset: NetworkPreset) -> SceneSpec:
    """The preset's reading of the raw maps.

    Raises:
        SettingsError: If pixels are neither unprojected at their centre nor at their corner.
    """
    scene = preset.scene
    if scene.pixel_center not in (0.0, 0.5):
        raise SettingsError(f"pixels are unprojected at 0 or 0.5, this preset says {scene.pixel_center}")
    return SceneSpec(
        pixel_centre=0.0 if scene.pixel_center == 0.0 else 0.5,
        focal_epsilon=scene.focal_epsilon,
        activation=scene.activation,
        sh_degree=preset.harmonic_degree,
        voxel_size=scene.voxel_size,
        opacity_exponent=scene.opacity_exponent,
        gaussians=preset.gaussians is not None,
    )


def network_spec(preset: NetworkPreset, *, name: str, version: str, wanted: InputSpec, licence: str) -> ModelSpec:
    """The whole of it, for a network that is called ``name`` and fed as ``wanted`` says."""
    return ModelSpec(
        name=name, version=version, preset=preset.name, input=wanted, scene=scene_spec(preset), licence=licence
    )
