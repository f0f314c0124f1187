"""Policies and networks in files of their own."""

import io
import pickle
from collections.abc import Mapping
from typing import Any, BinaryIO, TypeVar

import torch as th
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.utils import get_device

from sb3_causalgdp.divergence import first_not_finite
from sb3_causalgdp.files import write_bytes
from sb3_causalgdp.saving.archives import TRUST, FileError, errors_of, is_model, named, opened, size_of
from sb3_causalgdp.saving.models import BLOCK, CONTENT, KNOWN, check_limits, check_tensor_file, plain_entries
from sb3_causalgdp.saving.plain import Known, decoded, read_json

SelfPolicy = TypeVar("SelfPolicy", bound="SavedPolicy")
SelfNetwork = TypeVar("SelfNetwork", bound="PickledAlone")


_FIRST_DEFAULTS: dict[str, Any] = {
    "net_arch": [256, 256],
    "critic_normalization": None,
    "normalize_observations": False,
    "prediction_type": "noise",
}
# Of all policies before there were these arguments
FIRST_ACTING: dict[str, Any] = {"use_ema": False, "exploration_optimism": -1.0}


def with_first_defaults(arguments: dict[str, Any]) -> dict[str, Any]:
    """
    :param arguments: Of a policy that was saved before the defaults changed
    :return: The same, with those defaults
    """
    changed = dict(arguments)
    if "critic_layer_norm" in changed:
        changed["critic_normalization"] = "layer" if changed.pop("critic_layer_norm") else None
    return {**_FIRST_DEFAULTS, **changed}


class PickledAlone(BaseModel):
    """A network that SB3 saves as a pickle, because it holds another one; a whole policy needs none."""

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfNetwork], path: Any, device: th.device | str = "auto", *, trusted: bool = False
    ) -> SelfNetwork:
        """
        Load a network that was saved alone.

        :param path: File, or file-like object
        :param device: Device on which the network should be
        :param trusted: Whether the file may bring Python objects that could run code
        :return: The network
        :raises ValueError: If the file is not trusted
        """
        if not trusted:
            raise FileError(
                f"{named(path)} is a pickle, which could run code: {TRUST}, or save the whole policy, which is none"
            )
        return super().load(path, device)


class SavedPolicy(BasePolicy):
    """A policy whose files are either whole or refused, and run nothing that they bring."""

    @classmethod
    def known_classes(cls) -> Known:
        """
        :return: What a saved policy may name
        """
        return KNOWN

    def first_not_finite(self, state_dict: Mapping[str, th.Tensor] | None = None) -> tuple[str, float] | None:
        """
        :param state_dict: Tensors by their names in this policy, None for its own
        :return: Name and value of the first number that is NaN or infinite, None if there is none. Buffers of features
            extractors may hold infinity, as masks of attention do
        """
        state_dict = self.state_dict() if state_dict is None else state_dict
        own = ("features_extractor.mean", "features_extractor.inverse_std")
        of_extractors = (name for name, _ in self.named_buffers() if "features_extractor" in name)
        buffers = [f"policy.{name}" for name in of_extractors if not name.endswith(own)]
        return first_not_finite(state_dict, "policy", buffers)

    def save(self, path: str) -> None:
        """
        Save the policy alone; a file is replaced only once the new one is complete.

        :param path: File, or file-like object
        """
        arguments = {**self._get_constructor_parameters(), "lr_schedule": None}
        written, entries = plain_entries(arguments, self.known_classes())
        left = {name: value for name, value in arguments.items() if name not in written}
        saved = {
            "state_dict": self.state_dict(),
            "data": left,
            CONTENT: entries[CONTENT].decode(),
            BLOCK: th.frombuffer(bytearray(entries[BLOCK] or b"0"), dtype=th.uint8),
        }
        # First in memory: on a full disk, PyTorch's error would be about a position
        stream = io.BytesIO()
        th.save(saved, stream)
        write_bytes(path, "", stream.getbuffer())

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfPolicy], path: Any, device: th.device | str = "auto", *, trusted: bool = False
    ) -> SelfPolicy:
        """
        Load a policy. Nothing that the file brings is run, unless it is trusted.

        :param path: File, or file-like object
        :param device: Device on which the policy should be
        :param trusted: Whether the file may bring Python objects that could run code: it has to, where you gave the policy
            classes of your own, or it was saved by a version that pickled all
        :return: The policy
        :raises ValueError: If the file is not whole, or not trusted and needs to be, or a tensor holds NaN or infinity
        """
        with errors_of(path, "cannot be loaded"), opened(path) as file:
            state, arguments = _read_policy(file, get_device(device), trusted, cls.known_classes())
            policy = cls(**arguments)
            policy.load_state_dict(state)
            found = policy.first_not_finite()
            if found is not None:
                raise ValueError(f"it is not a policy that can act: {found[0]} is {found[1]}")
            return policy.to(get_device(device))


def _read_policy(
    file: BinaryIO, device: th.device, trusted: bool, known: Known
) -> tuple[dict[str, th.Tensor], dict[str, Any]]:
    """Parameters, and the arguments of the constructor."""
    if is_model(file):
        raise ValueError("it is a whole model, which CausalGDP.load loads")
    if trusted:
        saved = th.load(file, map_location=device, weights_only=False)
    else:
        check_tensor_file(file, "it")
        try:
            saved = th.load(file, map_location=device, weights_only=True)
        except pickle.UnpicklingError as error:
            raise ValueError(f"it holds pickled objects, which could run code: {TRUST}") from error
    content = saved.get(CONTENT)
    arguments = {} if content is None else decoded(read_json(content), saved[BLOCK].cpu().numpy().tobytes(), known)
    arguments = {**saved["data"], **arguments}
    if "critic_normalization" not in arguments:
        arguments = with_first_defaults(arguments)
    arguments = {**FIRST_ACTING, **arguments}
    if not trusted:
        check_limits(arguments, size_of(file))
    # Schedules are not needed for predictions
    return saved["state_dict"], {**arguments, "lr_schedule": BasePolicy._dummy_schedule}
