"""How close an update comes to its matrix products alone, at the rate that the machine has for them."""

from typing import Any

import numpy as np

from benchmarks.speed import contestants
from benchmarks.speed.benchmark import HALF_CHEETAH, Benchmark
from benchmarks.speed.client import Worker, median_ratio
from benchmarks.speed.contestants import CHAIN, DEFAULT, ONE_STEP, ONE_STEP_RELU, compiled
from benchmarks.speed.results import Row, Verdict, markdown

COLUMNS = (
    "contestant",
    "MFLOP",
    "products",
    "ms at the rate of 256x256x256",
    "ms of its products alone",
    "ms of an update",
    "share of the floor",
    "share of its products alone",
    "share of the floor by PyTorch's own choice",
    "status",
)
RATE_COLUMNS = ("layer", "forward", "by_input", "by_weight", "all three", "all three, PyTorch's own choice")
# Batch, inputs, outputs of dense layers: hidden; first of denoiser and critics (HalfCheetah, Humanoid); ten candidates; last
LAYERS = [(256, 256, 256), (256, 39, 256), (256, 23, 256), (256, 381, 256), (2560, 256, 256), (10, 256, 256), (256, 256, 6)]
REFERENCE = (256, 256, 256)


def run(benchmark: Benchmark) -> None:
    """
    :param benchmark: What is shared
    """
    results = benchmark.results("floor")
    ours = [*contestants.main_settings(), contestants.one_step_relu()]
    who = [*benchmark.ours(ours), contestants.sb3("SAC"), *benchmark.diffusion_ql()]
    plain_of = {compiled(one.name): one.name for one in ours}

    def turn(worker: Worker) -> dict[str, float]:
        update = worker.ask("update", n=benchmark.updates)["cpu"] / benchmark.updates
        if worker.contestant.name in plain_of:
            return {"update": update}
        products = worker.ask("products")["value"]
        rates = _rates(worker)
        own = {"alone": products["seconds"], "products": products["n_products"]}
        return {"update": update, **own, "rate": rates["layer"], "default rate": rates["default"]}

    with benchmark.field(who, transitions=benchmark.transitions(HALF_CHEETAH)) as field:
        turns = field.interleaved(benchmark.rounds, turn)
        for one in who:
            row: Row = {"contestant": one.name}
            # What is compiled has the products of the plain code, which alone can be counted
            counted = plain_of.get(one.name, one.name)
            if one.name in turns and counted in turns:
                both = [{**plain, **own} for plain, own in zip(turns[counted], turns[one.name], strict=True)]
                row |= {"status": "ok", **_row(field.workers[counted].ask("flops")["value"], both)}
            results.rows.append(row | field.absent.get(one.name, {}))
        by_layer = next(iter(field.workers.values())).ask("layer_rates", shapes=LAYERS)["value"]
    rates: list[Row] = [
        {**one, "layer": name, "all three": one["layer"], RATE_COLUMNS[-1]: one["default"]} for name, one in by_layer.items()
    ]
    results.about = {"GFLOP/s of dense layers, batch x inputs x outputs": rates}
    shares = {row["contestant"]: row.get("share of the floor") for row in results.rows}
    results.verdicts = [
        Verdict("floor: share that one_step, Mish 3x256 reaches", shares.get(ONE_STEP), 0.5, 0.7),
        Verdict("floor: share that one_step, Mish 3x256 reaches, compiled", shares.get(compiled(ONE_STEP)), 0.5, 0.7),
        Verdict("floor: share that one_step, ReLU 3x256 reaches", shares.get(ONE_STEP_RELU), 0.5, 0.7),
        Verdict("floor: share that one_step, ReLU 3x256 reaches, compiled", shares.get(compiled(ONE_STEP_RELU)), 0.5, 0.7),
        Verdict("floor: share that the default reaches", shares.get(DEFAULT), None),
        Verdict("floor: share that the default reaches, compiled", shares.get(compiled(DEFAULT)), None),
        Verdict("floor: share that the exact chain, Mish 3x256 reaches", shares.get(CHAIN), None),
    ]
    results.write(COLUMNS)
    print("GFLOP/s of dense layers, batch x inputs x outputs\n" + markdown(rates, RATE_COLUMNS), flush=True)


def _rates(worker: Worker) -> dict[str, float]:
    """GFLOP/s of a hidden layer, forward and backward."""
    return next(iter(worker.ask("layer_rates", shapes=[REFERENCE])["value"].values()))


def _row(flops: dict[str, float], turns: list[dict[str, float]]) -> dict[str, Any]:
    columns = {name: [turn[name] for turn in turns] for name in turns[0]}
    floors, defaults = ([flops["total"] / 1e9 / rate for rate in columns[name]] for name in ("rate", "default rate"))
    return {
        "MFLOP": flops["total"] / 1e6,
        "flops": flops,
        "products": int(columns["products"][0]),
        "ms at the rate of 256x256x256": 1e3 * float(np.median(floors)),
        "ms of its products alone": 1e3 * float(np.median(columns["alone"])),
        "ms of an update": 1e3 * float(np.median(columns["update"])),
        "share of the floor": median_ratio(floors, columns["update"]),
        "share of its products alone": median_ratio(columns["alone"], columns["update"]),
        "share of the floor by PyTorch's own choice": median_ratio(defaults, columns["update"]),
    }
