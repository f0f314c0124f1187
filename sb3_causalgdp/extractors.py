"""Features of observations in standard deviations, as the world model measures them, so that nobody needs VecNormalize."""

import math

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs


class StandardizedExtractor(BaseFeaturesExtractor):
    """
    The features of another extractor minus their means, in standard deviations, within [-10, 10]; as they are until the policy
    writes the buffers. A feature whose ``inverse_std`` is 0 is hidden: it is 0.

    :param extractor: Gives the observation flattened
    :param standardizes: False only hides features, and leaves the others as they are
    """

    BOUND = 10.0

    mean: th.Tensor
    inverse_std: th.Tensor

    def __init__(self, extractor: BaseFeaturesExtractor, standardizes: bool = True) -> None:
        super().__init__(extractor._observation_space, extractor.features_dim)
        self.extractor = extractor
        self.standardizes = standardizes
        self.bound = self.BOUND if standardizes else math.inf
        self.register_buffer("mean", th.zeros(extractor.features_dim))
        self.register_buffer("inverse_std", th.ones(extractor.features_dim))

    @staticmethod
    def may_cover(extractor_class: type[BaseFeaturesExtractor]) -> bool:
        """
        :param extractor_class: Class of a features extractor
        :return: Whether its features are the state variables, where no observation is an image
        """
        return extractor_class in (FlattenExtractor, CombinedExtractor)

    @classmethod
    def covers(cls, extractor: BaseFeaturesExtractor, state_dim: int) -> bool:
        """
        :param extractor: A features extractor
        :param state_dim: Number of state variables of the world model
        :return: Whether its features are these variables
        """
        return cls.may_cover(type(extractor)) and extractor.features_dim == state_dim

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        standardized = (self.extractor(observations) - self.mean) * self.inverse_std
        return standardized.clamp(-self.bound, self.bound)
