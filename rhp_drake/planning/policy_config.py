"""The policies a scenario can name, as plain data, and how they are made."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import math
from typing import Final, TypeAlias

from rhp_drake.errors import InputError
from rhp_drake.planning.policy import Policy

DEFAULT_Q_NETWORK: Final = "package://rhp_drake/q_network/three_boxes.safetensors"


@dataclass(kw_only=True)
class RecedingHorizonConfig:
    """RHP (section VI of the paper).

    Attributes:
        num_roll_outs: n, at least 1.
        horizon: h, at least 1.
        temperature: tau > 0 of the soft-max, in actions.
        q_network: File of the weights.
    """

    num_roll_outs: int = 6
    horizon: int = 6
    temperature: float = 0.5
    q_network: str = DEFAULT_Q_NETWORK

    def validate(self) -> None:
        """Raises an `InputError` that names the first impossible value."""
        for name in ("num_roll_outs", "horizon"):
            if getattr(self, name) < 1:
                raise InputError(
                    f"policy.{name} is {getattr(self, name)}; it must be at least 1."
                )
        if not 0 < self.temperature < math.inf:
            raise InputError(
                f"policy.temperature is {self.temperature}; it must be above 0 and "
                "finite."
            )


@dataclass(kw_only=True)
class GreedyConfig:
    """GP: the action of the highest value; RHP with h = 0.

    Attributes:
        q_network: File of the weights.
    """

    q_network: str = DEFAULT_Q_NETWORK

    def validate(self) -> None:
        """Nothing can be impossible."""


@dataclass(kw_only=True)
class OpenLoopConfig:
    """KDP: one plan of the kinodynamic RRT, executed blindly.

    Attributes:
        time_limit: Of the planning, s, above 0.
    """

    time_limit: float = 120.0

    def validate(self) -> None:
        """Raises an `InputError` if the limit is impossible."""
        if not 0 < self.time_limit < math.inf:
            raise InputError(
                f"policy.time_limit is {self.time_limit}; it must be above 0 and "
                "finite."
            )


PolicyConfig: TypeAlias = RecedingHorizonConfig | GreedyConfig | OpenLoopConfig

# The policies of the paper's Table I, by short names.
PAPER_POLICIES: Final[dict[str, Callable[[], PolicyConfig]]] = {
    "kdp": OpenLoopConfig,
    "gp": GreedyConfig,
    "rhp33": partial(RecedingHorizonConfig, num_roll_outs=3, horizon=3),
    "rhp66": partial(RecedingHorizonConfig, num_roll_outs=6, horizon=6),
}


def MakePolicy(config: PolicyConfig, num_objects: int, num_threads: int = 1) -> Policy:
    """Makes the policy, with its own push model, for m = `num_objects`.

    Args:
        config: Which policy.
        num_objects: m.
        num_threads: Of its push model; more are faster and decide the same.

    Raises:
        InputError: If a value is impossible, or the weights are missing, corrupt or
            for another m.
    """
    from rhp_drake.planning.open_loop import OpenLoop
    from rhp_drake.planning.receding_horizon import RecedingHorizon
    from rhp_drake.push_model.transition import PushModel
    from rhp_drake.resources import resolve
    from rhp_drake.value.q_network import load_q_network

    config.validate()
    if isinstance(config, OpenLoopConfig):
        return OpenLoop(PushModel(num_objects, num_threads), config.time_limit)
    q_network = load_q_network(resolve(config.q_network), num_objects)
    push_model = PushModel(num_objects, num_threads)
    if isinstance(config, GreedyConfig):
        return RecedingHorizon(push_model, q_network, 0, 0, 1.0)
    return RecedingHorizon(
        push_model,
        q_network,
        config.num_roll_outs,
        config.horizon,
        config.temperature,
    )
