"""Relative error of the per-vertex gradient against the number of samples: 81,920-face icosphere, smooth colours, 256².

Run:  python -m benchmarks.gradient_error [--seeds 4]

The error is ‖g − g*‖ / ‖g*‖ over all vertices, root mean square over seeds; g* is a converged run with seeds of its own, 128
times the default surface samples and 512 times the default edge samples. All errors are relative to the whole gradient; the
time is that of the backward pass, the median over seeds.
"""

from __future__ import annotations

import argparse

import torch
from tqdm import tqdm

from .common import Kernel, sphere


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    seeds = parser.parse_args().seeds
    kernel = Kernel(*sphere(256))
    n_surface, n_edge = kernel.default_samples()
    print(f"default samples: {n_surface:,} on surfaces, {n_edge:,} at edges; {torch.get_num_threads()} threads")
    interior, boundary = kernel.references()
    whole = interior + boundary

    def report(name: str, target: torch.Tensor, surface: int = -1, edge: int = -1, **terms: bool) -> None:
        runs = [kernel.gradient(surface, edge, seed, **terms) for seed in range(seeds)]
        errors = [((g - target).norm() / whole.norm()).item() for g, _ in runs]
        error = (sum(e * e for e in errors) / seeds) ** 0.5
        milliseconds = 1e3 * sorted(seconds for _, seconds in runs)[seeds // 2]
        tqdm.write(f"{name:42s} {100 * error:7.3f} %   {milliseconds:7.1f} ms")

    report("both, default samples", whole)
    for factor in (0.25, 1, 4, 16):
        n = int(factor * n_surface)
        report(f"interior, {n:9,d} surface samples", interior, surface=n, boundary=False)
    for factor in (0.25, 1, 4, 16):
        n = int(factor * n_edge)
        report(f"boundary, {n:9,d} edge samples", boundary, edge=n, interior=False)


if __name__ == "__main__":
    main()
