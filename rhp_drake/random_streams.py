"""Random generators named by a path, so that the same seed gives the same bits.

Every draw in the project comes from ``stream(seed, *path)``.  A path names what
the draw is for, e.g. ``stream(3, "decision", 7)``; streams with different paths
are statistically independent (NumPy's ``SeedSequence``), whatever the number or
the order of workers.
"""

from typing import Final
import zlib

import numpy as np

# First elements of the paths of the task instances.  Because the purpose is part
# of the path, training, validation and evaluation instances can never meet, even
# under the same seed.
TRAINING: Final = "training"
VALIDATION: Final = "validation"
EVALUATION: Final = "evaluation"


def stream(seed: int, *path: str | int) -> np.random.Generator:
    """Makes the generator that belongs to `path` under `seed`.

    Args:
        seed: The experiment's seed, at least 0.
        path: What is drawn, from general to specific: names and indices (>= 0).

    Raises:
        ValueError: If the seed or an index is negative.
    """
    keys = []
    for part in path:
        if isinstance(part, str):
            # A tag keeps the name "a" from ever meeting the index crc32("a").
            keys += [1, zlib.crc32(part.encode())]
        elif part >= 0:
            keys += [0, int(part)]
        else:
            raise ValueError(f"stream path {path}: index {part} is negative.")
    if seed < 0:
        raise ValueError(f"seed {seed} is negative.")
    return np.random.Generator(
        np.random.PCG64(np.random.SeedSequence(entropy=seed, spawn_key=tuple(keys)))
    )
