#!/usr/bin/env python3
"""A peer of tokens.py: the same networks in PyTorch, eager, planned and sampled by the same loops.

One request a line on standard input, one answer a line: init (preset, kind, threads), plan (answers), decode, quit. The
networks are those of tests/golden/engine; positions are turned in f32, and an autoregressive planner keeps keys and
values as ours does, so that both do the same work.
"""

import pathlib
import sys
import time

from peer import serve

GOLDEN = pathlib.Path(__file__).resolve().parents[1] / "tests" / "golden" / "engine"
sys.path.insert(0, str(GOLDEN))
FRAMES, RHO, CONDITION = 120, 4, 173
STEPS = 1000
ITERATIONS = 10
# fast27 of GLIDE.
VISITED = [0, 22, 44, 66, 88, 111, 133, 155, 177, 199, 200, 222, 244, 266, 288, 311, 333, 355, 377]
VISITED += [399, 400, 500, 599, 600, 799, 800, 997]
# Of each preset: width, convolutions, residual blocks, codes, blocks of the denoiser.
TOKENIZERS = {
    "tiny": (48, 32, 2, 32, 2),
    "small": (128, 128, 3, 256, 3),
    "base": (768, 512, 3, 1024, 4),
}
# Width, heads, layers, convolutions, residual blocks.
PLANNERS = {
    ("tiny", False): (48, 4, 2, 32, 1),
    ("tiny", True): (48, 4, 2, 32, 1),
    ("small", False): (192, 6, 4, 128, 2),
    ("small", True): (192, 6, 4, 128, 2),
    ("base", False): (384, 6, 6, 512, 3),
    ("base", True): (768, 12, 9, 512, 3),
}


class Torch:
    def init(self, preset: str, kind: str, threads: int) -> dict:
        import planner
        import tokens
        import torch

        self.torch, self.functional = torch, torch.nn.functional
        torch.set_num_threads(threads)
        torch.manual_seed(1)
        self.is_causal = kind == "autoregressive"
        width, conv_width, depth, codes, blocks = TOKENIZERS[preset]
        sizes = tokens.TokensConfig(width, conv_width, depth, codes, RHO, blocks)
        self.tokenizer = tokens.Tokenizer(sizes).eval().float()
        width, heads, layers, conv_width, depth = PLANNERS[preset, self.is_causal]
        config = planner.PlannerConfig(
            self.is_causal, codes, RHO, width, heads, 4, layers, conv_width, depth, CONDITION
        )
        self.planner, self.heads, self.codes = planner.Planner(config).eval(), heads, codes
        for network in (self.tokenizer, self.planner):
            for parameter in network.parameters():
                torch.nn.init.normal_(parameter, std=0.02)
        rates = 10_000.0 ** (-torch.arange(0, width // heads, 2) / (width // heads))
        angles = torch.arange(FRAMES // RHO + 1)[:, None] * rates
        self.turns = torch.polar(torch.ones_like(angles), angles)
        count = lambda network: sum(p.numel() for p in network.parameters())
        return {"tokenizer": count(self.tokenizer), "planner": count(self.planner)}

    def conditions(self, answers: int):
        """Music and the vector of the window, of as many answers as guidance needs."""
        torch = self.torch
        music = self.planner.music(torch.randn(answers, FRAMES, CONDITION))
        top = self.planner.get_submodule("global")(music.mean(1))
        return music, top + self.planner.style(torch.zeros(answers, 8))

    def layer(self, layer, h, past, first: int):
        """A layer at the positions from `first` on; all positions see all, or each those up to itself."""
        torch = self.torch
        b, n, d = h.shape
        parts = layer.attn.qkv(layer.attn.norm(h)).chunk(3, -1)
        q, k, v = (x.reshape(b, n, self.heads, d // self.heads).transpose(1, 2) for x in parts)
        q, k = (self.turned(x, first) for x in (q, k))
        if past is not None:
            k, v = torch.cat([past[0], k], 2), torch.cat([past[1], v], 2)
        y = self.functional.scaled_dot_product_attention(q, k, v)
        h = h + layer.attn.proj(y.transpose(1, 2).reshape(b, n, d))
        return h + layer.ff(h), (k, v)

    def turned(self, x, first: int):
        torch = self.torch
        turns = self.turns[first : first + x.shape[2]]
        pairs = torch.view_as_complex(x.reshape(*x.shape[:-1], -1, 2).contiguous())
        return torch.view_as_real(pairs * turns).flatten(-2)

    def plan(self, answers: int = 2) -> dict:
        torch = self.torch
        n = FRAMES // RHO
        started = time.perf_counter()
        with torch.inference_mode():
            music, top = self.conditions(answers)
            if self.is_causal:
                past = [None] * len(self.planner.layers)
                h = top[:, None] + music[:, :1]
                for i in range(n):
                    for j, layer in enumerate(self.planner.layers):
                        h, past[j] = self.layer(layer, h, past[j], i)
                    token = self.planner.out(self.planner.norm(h))[:1, 0].argmax(-1)
                    if i + 1 < n:
                        h = self.planner.table[token][:, None] + music[:, i + 1 : i + 2]
            else:
                tokens = torch.full((answers, n), self.codes)
                for _ in range(ITERATIONS):
                    h = torch.cat([top[:, None], self.planner.table[tokens] + music], 1)
                    for layer in self.planner.layers:
                        h, _ = self.layer(layer, h, None, 0)
                    logits = self.planner.out(self.planner.norm(h[:, 1:]))
                    tokens = logits[:1].argmax(-1).expand(answers, -1)
        return {"wall_s": time.perf_counter() - started}

    def decode(self) -> dict:
        """27 steps of DDPM over x0, whose posterior is two products and a sum."""
        torch = self.torch
        started = time.perf_counter()
        with torch.inference_mode():
            tokens = torch.arange(FRAMES // RHO)[None] * 7 % self.codes
            signal = self.tokenizer.decoder(self.tokenizer.codebook[tokens], FRAMES)
            x = torch.randn(1, FRAMES, 25)
            for t in reversed(VISITED):
                x0 = self.tokenizer.denoiser(x, torch.tensor([t]), signal).clamp(-5, 5)
                x = 0.5 * x0 + 0.5 * x + 0.1 * torch.randn_like(x)
        return {"wall_s": time.perf_counter() - started}


def main() -> None:
    serve(Torch())


if __name__ == "__main__":
    main()
