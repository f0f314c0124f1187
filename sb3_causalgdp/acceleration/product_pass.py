"""Matrix products in compiled graphs by the faster library; imports PyTorch's compiler, so only for those who compile."""

import torch as th
from torch._inductor.custom_graph_pass import CustomGraphPass, get_hash_for_files

from sb3_causalgdp.acceleration import products

_MM, _ADDMM = th.ops.aten.mm.default, th.ops.aten.addmm.default


class OneDnnProducts(CustomGraphPass):
    """Puts oneDNN's linear layer in place of PyTorch's products of 32-bit matrices, where no size is too small for it."""

    def __call__(self, graph: th.fx.Graph) -> None:
        """
        :param graph: What is compiled, changed in place
        """
        for node in list(graph.nodes):
            if node.op != "call_function" or node.target not in (_MM, _ADDMM):
                continue
            *bias, left, right = node.args
            if not _is_covered(left.meta["val"], right.meta["val"], *(one.meta["val"] for one in bias)) or node.kwargs:
                continue
            with graph.inserting_before(node):
                weight = graph.call_function(th.ops.aten.permute.default, (right, [1, 0]))
                weight.meta["val"] = right.meta["val"].t()
                arguments = (left, weight, bias[0] if bias else None)
                layer = graph.call_function(th.ops.sb3_causalgdp.linear.default, arguments)
                layer.meta.update(node.meta)
            node.replace_all_uses_with(layer)
            graph.erase_node(node)

    def uuid(self) -> bytes:
        """What tells graphs in PyTorch's cache apart."""
        return get_hash_for_files((__file__, products.__file__))


def _is_covered(left: th.Tensor, right: th.Tensor, bias: th.Tensor | None = None) -> bool:
    # A bias of two dimensions is added to the product, not to each of its rows
    if left.dtype is not th.float32 or left.device.type != "cpu" or (bias is not None and bias.ndim != 1):
        return False
    return min(*left.shape, right.shape[1]) >= products.SMALLEST_SIZE
