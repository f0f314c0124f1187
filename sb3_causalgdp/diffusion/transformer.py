"""A denoiser that is a transformer over single variables, and that can look along the causal graph alone."""

import math

import torch as th
from torch import nn

from sb3_causalgdp.diffusion.denoisers import Velocity, one_width, sinusoidal_embedding
from sb3_causalgdp.diffusion.schedules import at_step


def causal_attention(
    state_to_state: th.Tensor,
    action_to_state: th.Tensor,
    state_to_reward: th.Tensor,
    action_to_reward: th.Tensor,
    threshold: float = 0.5,
) -> th.Tensor:
    """
    What each action component looks at: the states that it influences, and all that these effects depend on besides. The
    reward is an effect like a next state.

    :param state_to_state: Probability that s_i causes s'_j, entry ``[j, i]``, shape ``(n, n)``
    :param action_to_state: Probability that a_k causes s'_j, entry ``[j, k]``, shape ``(n, d)``
    :param state_to_reward: Probability that the reward reads s'_j, shape ``(n,)``
    :param action_to_reward: Probability that the reward reads a_k, shape ``(d,)``
    :param threshold: From which probability on there is an edge
    :return: Whether action k looks at state i or at action l, entries ``[k, i]`` and ``[k, n + l]``, boolean,
        shape ``(d, n + d)``
    """
    parents = th.cat([state_to_state, action_to_state], dim=1) >= threshold
    of_reward = th.cat([state_to_reward, action_to_reward]) >= threshold
    # Rows are effects: the next states, and the reward
    causes = th.cat([parents, of_reward[None]]).float()
    n_states, n_actions = action_to_state.shape
    own = th.cat([th.eye(n_states), th.zeros(1, n_states)]).to(causes)
    reads = causes.clone()
    reads[:, :n_states] += own
    seen = causes[:, n_states:].T @ reads > 0.0
    seen[:, n_states:] |= th.eye(n_actions, dtype=th.bool, device=seen.device)
    return seen


class TransformerDenoiser(nn.Module):
    """
    Predicts the noise with a transformer whose tokens are the variables of the state, the action's components and the
    diffusion step.

    After :meth:`set_graph`, a token of an action looks at the tokens of :func:`causal_attention` and at the step, and tokens
    of states at themselves: no other state can change what the first layer says of it. Through an action that it looks at,
    deeper layers may see what that one sees.

    :param action_dim: Number of action components d
    :param condition_dim: Number of features of the observation, one token each
    :param n_steps: Number of diffusion steps K
    :param net_arch: One equal width for each layer, like ``[64, 64]``
    :param activation_fn: Activation class
    :param time_embedding_dim: Size of the embedding of the diffusion step
    :param n_heads: Number of attention heads, which divides the width
    :param causal: Whether CausalGDP sets the graph at each refresh; needs an observation that is a vector, without a features
        extractor
    :param alpha_bar: Where the network gives the velocity, see :class:`~sb3_causalgdp.diffusion.denoisers.Velocity`, shape
        ``(K,)``; None where it gives the noise
    :raises ValueError: If the widths differ, or the heads do not divide them
    """

    time_table: th.Tensor
    attention: th.Tensor

    def __init__(
        self,
        action_dim: int,
        condition_dim: int,
        n_steps: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.Mish,
        time_embedding_dim: int = 16,
        n_heads: int = 4,
        causal: bool = False,
        alpha_bar: th.Tensor | None = None,
    ) -> None:
        super().__init__()
        width = one_width(net_arch)
        if isinstance(n_heads, bool) or not isinstance(n_heads, int) or n_heads < 1 or width % n_heads:
            raise ValueError(f"n_heads must be an integer that divides the width {width} of net_arch, got {n_heads!r}")
        self.action_dim, self.condition_dim, self.causal = action_dim, condition_dim, causal
        self.velocity = None if alpha_bar is None else Velocity(alpha_bar)
        n_variables = condition_dim + action_dim
        self.register_buffer("time_table", sinusoidal_embedding(n_steps, time_embedding_dim), persistent=False)
        # A float, because a state dict holds the graph as it holds weights
        self.register_buffer("attention", th.ones(n_variables + 1, n_variables + 1))
        # Each variable has a direction of its own for its value, and one that says which it is
        self.value_embedding = nn.Parameter(th.randn(n_variables, width) / math.sqrt(width))
        self.name_embedding = nn.Parameter(th.randn(n_variables, width) / math.sqrt(width))
        self.time_layer = nn.Linear(time_embedding_dim, width)
        self.layers = nn.ModuleList(_Layer(width, n_heads, activation_fn) for _ in net_arch)
        self.output_norm = nn.LayerNorm(width)
        self.output_layer = nn.Linear(width, 1)

    @th.no_grad()
    def set_graph(
        self,
        state_to_state: th.Tensor,
        action_to_state: th.Tensor,
        state_to_reward: th.Tensor,
        action_to_reward: th.Tensor,
        threshold: float = 0.5,
    ) -> None:
        """
        Look along this graph alone from now on; the arguments are those of :func:`causal_attention`.

        :param state_to_state: Shape ``(n, n)``, where n is the number of features
        :param action_to_state: Shape ``(n, d)``
        :param state_to_reward: Shape ``(n,)``
        :param action_to_reward: Shape ``(d,)``
        :param threshold: From which probability on there is an edge
        :raises ValueError: If the graph is not one of as many states and actions as there are tokens
        """
        wanted = (self.condition_dim, self.action_dim)
        if tuple(action_to_state.shape) != wanted:
            raise ValueError(f"action_to_state must have the denoiser's shape {wanted}, got {tuple(action_to_state.shape)}")
        seen = causal_attention(state_to_state, action_to_state, state_to_reward, action_to_reward, threshold)
        attention = th.eye(len(self.attention))
        attention[self.condition_dim : -1, :-1] = seen.float()
        attention[:, -1] = 1.0
        self.attention.copy_(attention)

    def forward(self, noisy_action: th.Tensor, step: int | float | th.Tensor, condition: th.Tensor) -> th.Tensor:
        """
        :param noisy_action: a^k, shape ``(batch, d)``
        :param step: Diffusion step in [0, K-1], an index or a number between two: one for all, or shape ``(batch,)``
        :param condition: Features of the observation, shape ``(batch, condition_dim)``
        :return: Predicted noise, shape ``(batch, d)``
        """
        values = th.cat([condition, noisy_action], dim=1).unsqueeze(2)
        time = self.time_layer(at_step(self.time_table, step)).expand(noisy_action.shape[0], -1).unsqueeze(1)
        tokens = th.cat([values * self.value_embedding + self.name_embedding, time], dim=1)
        bias = th.zeros_like(self.attention).masked_fill(self.attention == 0.0, -math.inf)
        for layer in self.layers:
            tokens = layer(tokens, bias)
        output = self.output_layer(self.output_norm(tokens[:, self.condition_dim : -1])).squeeze(2)
        return output if self.velocity is None else self.velocity.noise(output, noisy_action, step)


class _Layer(nn.Module):
    """Attention and a network of one hidden layer, each behind a normalisation and added to what came in."""

    def __init__(self, width: int, n_heads: int, activation_fn: type[nn.Module]) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.attention_norm, self.network_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.to_attention = nn.Linear(width, 3 * width)
        self.from_attention = nn.Linear(width, width)
        self.network = nn.Sequential(nn.Linear(width, 2 * width), activation_fn(), nn.Linear(2 * width, width))

    def forward(self, tokens: th.Tensor, bias: th.Tensor) -> th.Tensor:
        batch, n_tokens, width = tokens.shape
        parts = self.to_attention(self.attention_norm(tokens)).view(batch, n_tokens, 3, self.n_heads, -1)
        query, key, value = parts.permute(2, 0, 3, 1, 4)
        # Written out: PyTorch's fused attention has no forward-mode derivative, which the covariance tweedie takes
        weights = (query @ key.mT / math.sqrt(query.shape[3]) + bias).softmax(dim=3)
        tokens = tokens + self.from_attention((weights @ value).transpose(1, 2).reshape(batch, n_tokens, width))
        return tokens + self.network(self.network_norm(tokens))
