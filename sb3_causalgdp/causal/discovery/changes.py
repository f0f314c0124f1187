"""When the world changes: rows from before are forgotten at once, and not when the window has passed them."""

from collections.abc import Callable

import numpy as np

from sb3_causalgdp.causal.statistics.basis import BasisMoments

FEWEST_BLOCKS = 6  # so that the newest ones have errors by jackknife
SURE = 0.95
FEWEST_EDGES = 3  # by chance, and by a policy that learns, it was never more than two


def forget_what_changed(statistics: BasisMoments, masks: Callable[[BasisMoments], np.ndarray], min_rows: int) -> str:
    """
    Compare the graph of the newest rows of a window with that of the rows before. Where at least three edges are there with a
    probability above .95 in one and below .05 in the other, the older rows are forgotten, and the first of the newer blocks,
    in which the change may have been.

    :param statistics: Of the window; without one, or with fewer than 6 blocks, nothing is done
    :param masks: Finds probabilities of edges, shape ``(m, p)``
    :param min_rows: Number of rows that it needs
    :return: what was forgotten, empty if nothing was
    """
    blocks = statistics.dynamics.blocks
    n_new = statistics.dynamics.n_blocks // 2 - 1
    if statistics.dynamics.window is None or statistics.dynamics.n_blocks < FEWEST_BLOCKS or len(blocks) <= n_new:
        return ""
    parts = [statistics.with_blocks(which) for which in (slice(None, -n_new), slice(-n_new, None))]
    if any(part.dynamics.count < min_rows or not part.raw.blocks for part in parts):
        return ""
    before, now = (masks(part) for part in parts)
    sure = (np.minimum(before, now) < 1.0 - SURE) & (np.maximum(before, now) > SURE)
    n_edges = int(sure.sum())
    if n_edges < FEWEST_EDGES:
        return ""
    n_kept = sum(block.count for block in blocks[-(n_new - 1) :])
    statistics.forget_old(n_kept)
    return f"{n_edges} edges are others in the newest {n_kept:.0f} transitions than before: older ones are forgotten"
