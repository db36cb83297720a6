"""Figures of sweeps: recorded trials in, pictures and the numbers behind them out.

A sweep declares its figures under `sweep.figures`, as components: `name: {_target_: class, ...arguments}`.
"""
