"""Offline data: D4RL's maze environments and scores, datasets that are made on this machine."""

from sb3_causalgdp.offline.registration import register_environments

register_environments()

__all__ = ["register_environments"]
