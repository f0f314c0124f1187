"""What can be asked of every contestant whose update is PyTorch's."""

from typing import Any, Protocol

import torch as th

from benchmarks.speed.workers import matmuls

# The environment says one thread as well; this also holds where PyTorch was built without OpenMP
th.set_num_threads(1)


class _Updates(Protocol):
    def update(self, n: int) -> None: ...


class TorchContestant:
    """Floating point operations and matrix products of one update; the rate of the machine's own."""

    # Means over a cycle: TD3's actor has every second update, CausalGDP's every third
    def flops(self: _Updates) -> dict[str, float]:
        """Floating point operations of one update."""
        return {name: count / matmuls.CYCLE for name, count in matmuls.count_flops(lambda: self.update(matmuls.CYCLE)).items()}

    def products(self: _Updates) -> dict[str, float]:
        """Seconds of one update's matrix products, each layout alone."""
        alone = matmuls.products_alone(lambda: self.update(matmuls.CYCLE))
        return {name: value / matmuls.CYCLE for name, value in alone.items()}

    def layer_rates(self, shapes: list[tuple[int, int, int]]) -> dict[str, Any]:
        """
        :param shapes: Batch, inputs and outputs of dense layers
        """
        return {"x".join(map(str, shape)): matmuls.layer_rate(*shape) for shape in shapes}
