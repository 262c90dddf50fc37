"""Options that do not apply to a system are refused when it is opened, never ignored."""

from bathyscope.errors import SettingsError
from bathyscope_train.systems.system import SystemOptions


def refuse_options(name: str, options: SystemOptions, *, takes: tuple[str, ...]) -> None:
    """Refuse an option that was set and does not apply.

    Raises:
        SettingsError: Names the option and what the system takes.
    """
    default = SystemOptions()
    for option in SystemOptions.model_fields:
        value = getattr(options, option)
        if option not in takes and value != getattr(default, option):
            raise SettingsError(
                f"{name}: {option} {value!r} does not apply to it; it takes {', '.join(takes) or 'no options'}"
            )
