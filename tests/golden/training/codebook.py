"""How a codebook is learned: fifty updates in NumPy, float64, written from the published definition.

    N_k <- mu N_k + (1 - mu) n_k,  m_k <- mu m_k + (1 - mu) sum of the latents whose nearest code is k
    c_k <- m_k / N_k where N_k >= 1, else a latent of the batch

(van den Oord et al. 2017, appendix A.1; T2M-GPT and MoMask, `QuantizeEMAReset`: mu = 0.99, N = 1 and m = c at first.)
Which latent is put in the place of a code is a rule here, not chance: number (7 k + 3 i) mod M at update i. Latents are u
of `codebook.latents.i`, from the thirtieth update on a quarter of it, so that codes of the outskirts die.
"""

import numpy as np
import weights

MU, LEAST = 0.99, 1.0
N_UPDATES, SHRINKS_AT = 50, 30
ROWS, LATENTS, WIDTH = 23, 37, 5
KEPT = (0, 1, 9, 29, 30, 49)


def latents(i: int) -> np.ndarray:
    u = weights.given(f"codebook.latents.{i}", (LATENTS, WIDTH)).astype(np.float64)
    return u * (1.0 if i < SHRINKS_AT else 0.25)


def candidates(h: np.ndarray, i: int) -> np.ndarray:
    return np.stack([h[(7 * k + 3 * i) % LATENTS] for k in range(ROWS)])


def transcript() -> dict[str, np.ndarray]:
    """Returns tokens and replaced rows of every update, and codebook, usage and sums after some."""
    codes = candidates(latents(0), 0)
    counts, sums = np.ones(ROWS), codes.copy()
    tokens, replaced, kept = [], [], {"codebook": [], "usage": [], "sums": []}
    for i in range(N_UPDATES):
        h = latents(i)
        distances = ((h[:, None] - codes[None]) ** 2).sum(-1)
        z = distances.argmin(1)
        onehot = np.eye(ROWS)[z]
        counts = MU * counts + (1 - MU) * onehot.sum(0)
        sums = MU * sums + (1 - MU) * onehot.T @ h
        alive = counts >= LEAST
        # One use in every batch is a usage of 1, in float32 too: 0.99 and 1 - 0.99 add up to it.
        if (np.abs(counts - LEAST) < 1e-9)[counts != LEAST].any():
            raise ValueError(f"update {i}: a usage is {LEAST} but for rounding; change the latents")
        codes = np.where(alive[:, None], sums / counts[:, None], candidates(h, i))
        tokens.append(z)
        replaced.append(~alive)
        if i in KEPT:
            for name, value in (("codebook", codes), ("usage", counts), ("sums", sums)):
                kept[name].append(value)
    print(f"codebook: {np.sum(replaced)} replacements, {np.sum(replaced, axis=0)} by row")
    found = {"tokens": np.stack(tokens), "replaced": np.stack(replaced)} | {
        name: np.stack(values) for name, values in kept.items()
    }
    return {name: value.astype(np.float64) for name, value in found.items()}
