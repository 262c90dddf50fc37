"""``--dry-run`` of pre-training: what a run would do, without doing it."""

import yaml

from bathyscope_train.config import PretrainSettings
from bathyscope_train.pretrain import choose_parameters, initial_network, parameter_groups

_FLOAT = 4
_MIB = 1 << 20


def pretrain_plan(settings: PretrainSettings) -> str:
    """Resolved settings, what is trained, and the memory that one process takes besides activations.

    Raises:
        SettingsError: If the preset cannot be trained this way.
        CheckpointError: If the initial checkpoint cannot be used.
    """
    network = initial_network(settings)
    choose_parameters(network, settings.only)
    groups = parameter_groups(network, settings)
    counts = [sum(value.numel() for value in group["params"]) for group in groups]
    everything = sum(value.numel() for value in network.state_dict().values())
    trained = sum(counts)
    # weights and their running average; gradients and two moments of what is trained
    memory = _FLOAT * (2 * everything + 3 * trained) / _MIB
    text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=110)
    lines = [
        "settings",
        *(f"  {line}" for line in text.splitlines()),
        f"parameters of {network.preset.name!r}",
        *(
            f"  {count:>12,}  rate {group['lr']:g}, weight decay {group['weight_decay']:g}"
            for group, count in zip(groups, counts, strict=True)
        ),
        f"  {everything - trained:>12,}  frozen",
        f"memory of one process: {memory:,.1f} MiB for weights, their average, gradients and AdamW, and activations",
    ]
    return "\n".join(lines)
