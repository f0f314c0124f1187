"""Compiling in tests."""

from functools import wraps

import torch as th


def compile_for_tests(monkeypatch, **options):
    """Another backend than inductor's C++, whose compilation takes a minute; a graph that breaks is an error."""
    compile_ = th.compile

    @wraps(compile_)
    def compile_whole(function, **kwargs):
        return compile_(function, **{**kwargs, "options": None, "fullgraph": True, **options})

    monkeypatch.setattr(th, "compile", compile_whole)
