"""What error messages tell one to type: commands that work without a package index that has this package."""

import re

EXTRAS = {
    "plots": ("matplotlib", "networkx", "pandas"),
    "offline": ("minari[hdf5]", "gymnasium-robotics"),
    "zoo": ("rl-zoo3>=2.7", "sb3-contrib", "requests", "seaborn", "moviepy", "jinja2"),
    "watch": ("bokeh",),
    "lingam": ("lingam",),
    "export": ("onnx", "onnxscript", "onnxruntime"),
    "train": ("tqdm", "rich", "tensorboard"),
    "cluster": ("ray",),
}
"""Packages of the extras, as in ``setup.cfg``."""
MAKE = "python -m sb3_causalgdp.datasets make"
MADE_HERE = (
    (r"maze2d|pointmaze", r"umaze|medium|large", "maze2d-{kind}"),
    (r"halfcheetah|hopper|walker2d|pen", r"medium-replay|medium|human|cloned|expert|simple", "{name}-medium"),
)


def how_to_install(extra: str) -> str:
    """
    :param extra: One of :data:`EXTRAS`
    :return: The command that installs its packages
    """
    names = (f'"{name}"' if re.search(r"[^\w-]", name) else name for name in EXTRAS[extra])
    return f"pip install {' '.join(names)}"


def how_to_make(dataset_id: str) -> str:
    """
    :param dataset_id: Id of a Minari dataset that is not to be had
    :return: The command that makes it, or the one that is most like it, without a network
    """
    for names, kinds, pattern in MADE_HERE:
        name, kind = re.search(rf"\b({names})\b", dataset_id), re.search(rf"\b({kinds})\b", dataset_id)
        if name and kind:
            task = pattern.format(name=name[1], kind=kind[1])
            task += "-dense" if name[1].startswith(("maze", "point")) and "dense" in dataset_id else ""
            task += "-replay" if kind[1] == "medium-replay" else ""
            same = dataset_id == f"sb3_causalgdp/{task}-v0"
            return f"`{MAKE} {task}` makes {'it' if same else f'sb3_causalgdp/{task}-v0, which is like it,'} on this machine"
    return f"`{MAKE} --help` lists datasets that can be made on this machine"
