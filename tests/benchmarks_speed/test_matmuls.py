import pytest
import torch as th

from benchmarks.speed.workers import matmuls


def test_all_matrix_products_of_an_update_are_recorded_and_timed():
    network = th.nn.Sequential(th.nn.Linear(5, 16), th.nn.ReLU(), th.nn.Linear(16, 3, bias=False))
    blocks = th.randn(4, 16, 3, requires_grad=True)
    inputs = th.randn(8, 5)

    def update():
        (network(inputs).sum() + th.bmm(th.ones(4, 7, 16), blocks).sum()).backward()

    # Forward and by weight for both layers, by input for the second alone; the batched product has no other gradient
    expected = 2 * (2 * 8 * 5 * 16 + 3 * 8 * 16 * 3 + 2 * 4 * 7 * 16 * 3)
    assert matmuls.count_flops(update)["total"] == expected
    alone = matmuls.products_alone(update, seconds=1e-4)
    assert (alone["n_products"], alone["flops"]) == (7, expected)
    assert alone["seconds"] > 0.0


@pytest.mark.parametrize("name", ["forward", "by_input", "by_weight", "layer"])
def test_a_layer_has_a_rate(name):
    assert matmuls.layer_rate(16, 16, 16, seconds=1e-3)[name] > 0.0
