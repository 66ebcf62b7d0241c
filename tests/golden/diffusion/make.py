#!/usr/bin/env python3
"""Golden values of the diffusion: schedules, spacings, weights, and whole runs of the samplers.

    pip install -r tests/requirements.txt
    python tests/golden/diffusion/make.py        (NumPy alone; nothing is random)

Writes schedules.json beside itself. Every formula stands as its source prints it:

  betas        linear, betas_for_alpha_bar: guided-diffusion and improved-diffusion
               (gaussian_diffusion.py); cosine also as the reference design (3.2.2) prints it,
               which must agree; sqrt as the reference
  posterior    improved-diffusion, GaussianDiffusion.__init__ (DDPM eqs. 6 and 7)
  respacing    improved-diffusion, SpacedDiffusion.__init__
  timesteps    diffusers, DDIMScheduler.set_timesteps (trailing, leading, linspace); reference 8.1
  min-SNR      Hang et al. 2023, section 3.4
  runs         DDIM: reference 8.1 (_get_timesteps, _ddim_step); DDPM: reference 3.2.4 (p_sample);
               DPM-Solver++(2M): diffusers, DPMSolverMultistepScheduler, midpoint

Computed in NumPy's long double where that has 64 bits of mantissa, so that the subtractions from 1
in the published formulas do not show: at 1 - alpha_bar = 1e-4 doubles keep 12 digits of them.
"""

import json
import pathlib

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
LD = np.longdouble
assert np.finfo(LD).eps < 1.2e-19, "this machine's long double is too short; use x86-64"
PI = np.arctan(LD(1)) * 4
BETA_START, BETA_END = LD("0.0001"), LD("0.02")


def betas_for_alpha_bar(n, alpha_bar, low, high):
    betas = []
    for i in range(n):
        t1 = LD(i) / n
        t2 = LD(i + 1) / n
        betas.append(1 - alpha_bar(t2) / alpha_bar(t1))
    return np.clip(np.array(betas), low, high)


def cosine_of_the_reference(n):
    s = LD("0.008")
    t = np.linspace(LD(0), LD(n), n + 1) / n
    alphas_cumprod = np.cos((t + s) / (1 + s) * PI / 2) ** 2
    alphas_cumprod = alphas_cumprod / alphas_cumprod[0]
    betas = 1 - (alphas_cumprod[1:] / alphas_cumprod[:-1])
    return np.clip(betas, LD("0.0001"), LD("0.9999"))


def get_betas(name, n):
    if name == "linear":
        return np.linspace(BETA_START, BETA_END, n, dtype=LD)
    if name == "sqrt":
        return np.linspace(BETA_START ** LD("0.5"), BETA_END ** LD("0.5"), n, dtype=LD) ** 2
    s = LD("0.008")
    betas = betas_for_alpha_bar(
        n,
        lambda t: np.cos((t + s) / (1 + s) * PI / 2) ** 2,
        LD("0.0001"),
        LD("0.9999"),
    )
    np.testing.assert_allclose(betas, cosine_of_the_reference(n), rtol=1e-14)
    return betas


class Process:
    """The tables of improved-diffusion's GaussianDiffusion, from betas."""

    def __init__(self, betas):
        alphas = 1 - betas
        self.betas = betas
        self.alphas_cumprod = np.cumprod(alphas)
        self.alphas_cumprod_prev = np.append(LD(1), self.alphas_cumprod[:-1])
        self.posterior_variance = (
            betas * (1 - self.alphas_cumprod_prev) / (1 - self.alphas_cumprod)
        )
        self.posterior_mean_coef1 = (
            betas * np.sqrt(self.alphas_cumprod_prev) / (1 - self.alphas_cumprod)
        )
        self.posterior_mean_coef2 = (
            (1 - self.alphas_cumprod_prev) * np.sqrt(alphas) / (1 - self.alphas_cumprod)
        )
        self.snr = self.alphas_cumprod / (1 - self.alphas_cumprod)

    def respaced(self, use_timesteps):
        """Betas of the steps in use_timesteps, and the step of the network for each."""
        last_alpha_cumprod, new_betas, timestep_map = LD(1), [], []
        for i, alpha_cumprod in enumerate(self.alphas_cumprod):
            if i in use_timesteps:
                new_betas.append(1 - alpha_cumprod / last_alpha_cumprod)
                last_alpha_cumprod = alpha_cumprod
                timestep_map.append(i)
        return Process(np.array(new_betas)), timestep_map


def timesteps(total, n, spacing):
    if spacing == "trailing":
        steps = np.round(np.arange(total, 0, -total / n)).astype(int) - 1
    elif spacing == "leading":
        steps = (np.arange(0, n) * (total // n)).round()[::-1].astype(int)
    elif spacing == "linspace":
        steps = np.linspace(0, total - 1, n).round()[::-1].astype(int)
    else:
        step_size = total // n
        steps = np.array(list(range(total - 1, -1, -step_size))[:n])
    assert len(steps) == n, (total, n, spacing)
    return [int(t) for t in steps]


# The runs: a smooth made-up network, and noise by rule, both easily stated in any language.

N_VALUES = 15


def start():
    return 1.5 * np.sin(5 * np.arange(N_VALUES, dtype=LD) + 2)


def noise(draw):
    return 1.5 * np.sin(7 * LD(draw) + 3 * np.arange(N_VALUES, dtype=LD) + 1)


def network(process, prediction, x, t):
    a, s = np.sqrt(process.alphas_cumprod[t]), np.sqrt(1 - process.alphas_cumprod[t])
    x_0 = a * x - s * np.sin(x) / 10
    epsilon = (x - a * x_0) / s
    return {"epsilon": epsilon, "x0": x_0, "v": a * epsilon - s * x_0}[prediction]


def estimates(process, prediction, x, t, clip):
    a, s = np.sqrt(process.alphas_cumprod[t]), np.sqrt(1 - process.alphas_cumprod[t])
    output = network(process, prediction, x, t)
    if prediction == "epsilon":
        x_0 = (x - s * output) / a
        epsilon = output
    elif prediction == "x0":
        x_0 = output
        epsilon = (x - a * output) / s
    else:
        x_0 = a * x - s * output
        epsilon = a * output + s * x
    if clip is not None:
        x_0 = np.clip(x_0, -clip, clip)
        epsilon = (x - a * x_0) / s
    return x_0, epsilon


def run_ddim(process, prediction, n, spacing, eta, clip):
    steps, x = timesteps(len(process.betas), n, spacing), start()
    # The reference takes 0 where there is no step left, and 1 for alpha_bar of a step below 0.
    end = 0 if spacing == "reference" else -1
    for i, t in enumerate(steps):
        t_next = steps[i + 1] if i < len(steps) - 1 else end
        alpha = process.alphas_cumprod[t]
        alpha_next = process.alphas_cumprod[t_next] if t_next >= 0 else LD(1)
        x_0, noise_pred = estimates(process, prediction, x, t, clip)
        sigma = eta * np.sqrt((1 - alpha_next) / (1 - alpha)) * np.sqrt(1 - alpha / alpha_next)
        dir_xt = np.sqrt(1 - alpha_next - sigma**2) * noise_pred
        x = np.sqrt(alpha_next) * x_0 + dir_xt + sigma * noise(2 * i)
    return x


def run_ddpm(process, prediction, n, spacing, clip):
    x = start()
    spaced, timestep_map = process.respaced(timesteps(len(process.betas), n, spacing))
    for i, t in enumerate(reversed(range(n))):
        x_0, _ = estimates(process, prediction, x, timestep_map[t], clip)
        mean = spaced.posterior_mean_coef1[t] * x_0 + spaced.posterior_mean_coef2[t] * x
        x = mean + (np.sqrt(spaced.posterior_variance[t]) * noise(2 * i) if t > 0 else 0)
    return x


def run_dpm_solver(process, prediction, n, spacing, clip):
    steps, x, outputs = timesteps(len(process.betas), n, spacing), start(), []

    def alpha_sigma_lambda(t):
        alpha = np.sqrt(process.alphas_cumprod[t])
        sigma = np.sqrt(1 - process.alphas_cumprod[t])
        return alpha, sigma, np.log(alpha) - np.log(sigma)

    for i, s0 in enumerate(steps):
        x_0, _ = estimates(process, prediction, x, s0, clip)
        outputs.append(x_0)
        is_last = i == n - 1
        if is_last and spacing != "reference":
            x = x_0  # final_sigmas_type "zero"
            continue
        alpha_t, sigma_t, lambda_t = alpha_sigma_lambda(0 if is_last else steps[i + 1])
        _, sigma_s0, lambda_s0 = alpha_sigma_lambda(s0)
        h = lambda_t - lambda_s0
        lower_order_final = is_last and n < 15
        x = (sigma_t / sigma_s0) * x - (alpha_t * (np.exp(-h) - 1.0)) * outputs[-1]
        if i > 0 and not lower_order_final:
            _, _, lambda_s1 = alpha_sigma_lambda(steps[i - 1])
            r0 = (lambda_s0 - lambda_s1) / h
            D1 = (1.0 / r0) * (outputs[-1] - outputs[-2])
            x = x - 0.5 * (alpha_t * (np.exp(-h) - 1.0)) * D1
    return x


RUNS = [  # sampler, eta, schedule, T, prediction, n, spacing, clip
    ("ddim", 0.0, "cosine", 1000, "epsilon", 20, "reference", None),
    ("ddim", 0.5, "cosine", 1000, "epsilon", 7, "reference", None),
    ("ddim", 1.0, "linear", 1000, "epsilon", 50, "reference", None),
    ("ddim", 0.0, "cosine", 1000, "epsilon", 5, "linspace", None),
    ("ddim", 0.3, "cosine", 1000, "v", 13, "leading", None),
    ("ddim", 0.0, "sqrt", 1000, "x0", 20, "trailing", None),
    ("ddim", 0.0, "cosine", 1000, "epsilon", 20, "trailing", 1.0),
    ("ddpm", 0.0, "linear", 50, "epsilon", 50, "trailing", None),
    ("ddpm", 0.0, "cosine", 1000, "v", 10, "trailing", None),
    ("ddpm", 0.0, "cosine", 1000, "x0", 25, "leading", 1.0),
    ("dpm_solver", 0.0, "cosine", 1000, "epsilon", 8, "trailing", None),
    ("dpm_solver", 0.0, "linear", 1000, "v", 20, "linspace", None),
    ("dpm_solver", 0.0, "cosine", 1000, "x0", 10, "reference", None),
    ("dpm_solver", 0.0, "cosine", 1000, "epsilon", 20, "reference", 1.0),
]


def run(sampler, eta, schedule, total, prediction, n, spacing, clip):
    process = Process(get_betas(schedule, total))
    if sampler == "ddim":
        return run_ddim(process, prediction, n, spacing, LD(eta), clip)
    if sampler == "ddpm":
        return run_ddpm(process, prediction, n, spacing, clip)
    return run_dpm_solver(process, prediction, n, spacing, clip)


def numbers(values):
    return [float(x) for x in values]


def main():
    schedules, weights = [], []
    for name in ("linear", "cosine", "sqrt"):
        for n in (1000, 50, 7):
            process = Process(get_betas(name, n))
            some = sorted({*range(min(n, 5)), *range(0, n, 13), *range(max(n - 5, 0), n)})
            schedules.append(
                {
                    "schedule": name,
                    "n_steps": n,
                    "t": some,
                    "beta": numbers(process.betas[some]),
                    "alpha_bar": numbers(process.alphas_cumprod[some]),
                    "alpha_bar_prev": numbers(process.alphas_cumprod_prev[some]),
                    "snr": numbers(process.snr[some]),
                    "posterior_variance": numbers(process.posterior_variance[some]),
                    "posterior_mean_x0": numbers(process.posterior_mean_coef1[some]),
                    "posterior_mean_x_t": numbers(process.posterior_mean_coef2[some]),
                }
            )
        snr = Process(get_betas(name, 1000)).snr
        some = list(range(3, 1000, 83))
        for prediction, weigh in (
            ("epsilon", lambda snr, gamma: np.minimum(snr, gamma) / snr),
            ("x0", lambda snr, gamma: np.minimum(snr, gamma)),
            ("v", lambda snr, gamma: np.minimum(snr, gamma) / (snr + 1)),
        ):
            weights.append(
                {
                    "schedule": name,
                    "prediction": prediction,
                    "gamma": 5.0,
                    "t": some,
                    "weight": numbers(weigh(snr[some], LD(5))),
                }
            )
    spacings = [
        {"n_train": total, "n_steps": n, "spacing": spacing, "t": timesteps(total, n, spacing)}
        for spacing in ("trailing", "leading", "linspace", "reference")
        for total, n in ((1000, 20), (1000, 15), (1000, 8), (1000, 3), (50, 50), (7, 2), (16, 6))
    ]
    names = ("sampler", "eta", "schedule", "n_train", "prediction", "n_steps", "spacing", "clip")
    runs = [dict(zip(names, case), x=numbers(run(*case))) for case in RUNS]
    golden = {"schedules": schedules, "weights": weights, "spacings": spacings, "runs": runs}
    parts = []
    for name, rows in golden.items():
        lines = ",\n".join(json.dumps(row) for row in rows)
        parts.append(f"{json.dumps(name)}: [\n{lines}\n]")
    (HERE / "schedules.json").write_text("{\n" + ",\n".join(parts) + "\n}\n")


if __name__ == "__main__":
    main()
