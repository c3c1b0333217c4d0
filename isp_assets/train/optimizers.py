"""Optimizers of the training loop, and their state as plain tensors for a checkpoint.

SOAP (Vyas et al., "SOAP: Improving and Stabilizing Shampoo using Adam", 2024) is Adam in
the eigenbasis of each weight matrix's gradients. A step of the atlases takes a fifth more
time than Adam's, and far fewer reach the same loss.
"""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from isp_assets.errors import MissingExtraError

OptimizerName = Literal["adam", "soap"]

LOOKUP: Mapping[str, Any] = {"max_precondition_dim": 0, "betas": (0.9, 0.999)}
"""Settings of a group whose rows belong to single garments, as codes do: plain Adam, with a long memory
since a row has a gradient only when its garment is drawn."""


def make_optimizer(name: OptimizerName, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
    """An optimizer of parameter groups, each with its ``lr``.

    Raises:
        MissingExtraError: If it is "soap" and pytorch-optimizer is not installed.
    """
    if name == "adam":
        return torch.optim.Adam(groups, fused=True)
    try:
        from pytorch_optimizer import SOAP
    except ImportError as error:
        raise MissingExtraError("pytorch-optimizer", "train", "training with SOAP") from error
    return SOAP(groups, weight_decay=0.0)


def state_tensors(optimizer: torch.optim.Optimizer) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Everything that an optimizer remembers: its tensors by name, and the rest as JSON values."""
    tensors: dict[str, Tensor] = {}
    whole = optimizer.state_dict()
    rest = {
        "state": {str(index): _split(state, str(index), tensors) for index, state in whole["state"].items()},
        "steps": [group.get("step") for group in whole["param_groups"]],
    }
    return tensors, rest


def restore_state(
    optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], rest: Mapping[str, Any]
) -> None:
    """Give a new optimizer of the same groups what `state_tensors` took from another."""
    groups = optimizer.state_dict()["param_groups"]
    for group, step in zip(groups, rest["steps"], strict=True):
        if step is not None:
            group["step"] = step
    state = {int(index): _join(value, tensors) for index, value in rest["state"].items()}
    optimizer.load_state_dict({"state": state, "param_groups": groups})


def _split(value: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    """``value`` with every tensor moved to ``tensors`` and its name left in its place."""
    if isinstance(value, Tensor):
        # Bases are stored by columns; another order in memory would give other last bits after resuming.
        order = sorted(range(value.ndim), key=value.stride, reverse=True)
        tensors[name] = value.permute(order)
        return {"tensor": name, "order": order}
    if isinstance(value, dict):
        return {"fields": {key: _split(item, f"{name}.{key}", tensors) for key, item in value.items()}}
    if isinstance(value, list):
        return [_split(item, f"{name}.{index}", tensors) for index, item in enumerate(value)]
    return value


def _join(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    if isinstance(value, list):
        return [_join(item, tensors) for item in value]
    if isinstance(value, dict):
        if "tensor" in value:
            tensor, order = tensors[value["tensor"]], value["order"]
            return tensor.permute([order.index(axis) for axis in range(tensor.ndim)])
        return {key: _join(item, tensors) for key, item in value["fields"].items()}
    return value
