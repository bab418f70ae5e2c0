"""A transformer over frames of patch tokens that can be run frame by frame, exactly.

Tokens see all tokens of their own frame and of the H - 1 frames before it. Time enters only as rotations of the keys by
their age (rotary embedding, relative), so keys and values of a past frame stay what they are when the window slides on:
one frame at a time with keys and values kept gives what a pass over the whole sequence gives.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

ROTARY_BASE = 100.0
"""Ages are a few frames, so frequencies go down to 1 / 100 radians a frame only."""


MODULATION = 0.02
"""Standard deviation of the modulation's first weights: from zero, a condition is heard later."""


class FrameTransformer(nn.Module):
    """Pre-norm transformer, H frames wide, with a last layer norm.

    Args:
        dim: d, width of the tokens.
        depth, heads, head_dim, mlp: layers, attention heads and their width, hidden width of the feed-forward layers.
        history: H, frames a token sees, its own included.
        condition_dim: width of a condition that scales, shifts and gates every layer (AdaLN); None for none.
    """

    rotation: Tensor

    def __init__(
        self, dim: int, depth: int, heads: int, head_dim: int, mlp: int, history: int, condition_dim: int | None = None
    ):
        super().__init__()
        self.history, self.kept_dim = history, 2 * heads * head_dim
        self.blocks = nn.ModuleList(_Block(dim, heads, head_dim, mlp, condition_dim) for _ in range(depth))
        self.norm = nn.LayerNorm(dim)
        frequency = ROTARY_BASE ** -(torch.arange(head_dim // 2) / (head_dim // 2))
        angle = (torch.arange(history - 1, -1, -1.0)[:, None] * frequency).repeat_interleave(2, -1)  # a pair has one
        self.register_buffer("rotation", torch.stack([angle.cos(), angle.sin()]), persistent=False)

    def forward(
        self, x: Tensor, seen: Tensor, past: list[Tensor] | None = None, condition: Tensor | None = None
    ) -> tuple[Tensor, list[Tensor]]:
        """Tokens of T frames that follow the past.

        Args:
            x: (B, T, P, d).
            seen: int (B, T), how many frames each frame may look at, itself included; more than H counts as H.
            past: for each layer keys and values of the H - 1 frames before, (B, H - 1, P, 2 K); None if there are none.
            condition: (B, T, C).

        Returns:
            (B, T, P, d), and for each layer the keys and values of all H - 1 + T frames, (B, H - 1 + T, P, 2 K).
        """
        past = self.empty_past(len(x), x.shape[2]) if past is None else past
        x, kept, visible = self._but_the_last(x, seen, past, condition)
        x, frames = self.blocks[-1](x, past[-1], visible, self.rotation, condition)
        return self.norm(x), [*kept, frames]

    def keep(
        self, x: Tensor, seen: Tensor, past: list[Tensor] | None = None, condition: Tensor | None = None
    ) -> list[Tensor]:
        """The keys and values alone that `forward` returns, which takes no more than a part of the last layer."""
        past = self.empty_past(len(x), x.shape[2]) if past is None else past
        x, kept, _ = self._but_the_last(x, seen, past, condition)
        last: _Block = self.blocks[-1]
        return [*kept, last.keep(x, past[-1], condition)]

    def _but_the_last(
        self, x: Tensor, seen: Tensor, past: list[Tensor], condition: Tensor | None
    ) -> tuple[Tensor, list[Tensor], Tensor]:
        """All layers but one: tokens, keys and values; and what each frame may see."""
        batch, length, n_patches, _ = x.shape
        age = torch.arange(self.history - 1, -1, -1, device=x.device)
        visible = (age < seen[..., None]) | (age == 0)
        visible = visible[..., None].expand(-1, -1, -1, n_patches).reshape(batch * length, 1, 1, -1)
        kept = []
        for block, before in zip(self.blocks[:-1], past):
            x, frames = block(x, before, visible, self.rotation, condition)
            kept.append(frames)
        return x, kept, visible

    def empty_past(self, batch_size: int, n_patches: int) -> list[Tensor]:
        """Keys and values before the first frame, which nothing may look at."""
        shape = (batch_size, self.history - 1, n_patches, self.kept_dim)
        return [self.rotation.new_zeros(shape) for _ in self.blocks]


class _Block(nn.Module):
    def __init__(self, dim: int, heads: int, head_dim: int, mlp: int, condition_dim: int | None):
        super().__init__()
        self.heads, self.inner = heads, heads * head_dim
        plain = condition_dim is None
        self.attention_norm = nn.LayerNorm(dim, elementwise_affine=plain)
        self.qkv = nn.Linear(dim, 3 * self.inner, bias=False)
        self.out = nn.Linear(self.inner, dim)
        self.mlp_norm = nn.LayerNorm(dim, elementwise_affine=plain)
        self.mlp = nn.Sequential(nn.Linear(dim, mlp), nn.GELU(), nn.Linear(mlp, dim))
        self.modulation = None if plain else nn.Linear(condition_dim, 6 * dim)
        if self.modulation is not None:  # start near a plain block: little shift and scale, open gates
            nn.init.normal_(self.modulation.weight, std=MODULATION)
            with torch.no_grad():
                self.modulation.bias.copy_(torch.tensor([0.0, 0.0, 1.0] * 2).repeat_interleave(dim))

    def forward(
        self, x: Tensor, past: Tensor, visible: Tensor, rotation: Tensor, condition: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """(..., n_in) -> (..., n_out)."""
        if self.modulation is None:
            attended, kept = self._attend(self.attention_norm(x), past, visible, rotation)
            x = x + attended
            return x + self.mlp(self.mlp_norm(x)), kept
        shift, scale, gate, mlp_shift, mlp_scale, mlp_gate = self.modulation(condition).unsqueeze(-2).chunk(6, -1)
        y = torch.addcmul(shift, self.attention_norm(x), 1 + scale)
        attended, kept = self._attend(y, past, visible, rotation)
        x = torch.addcmul(x, attended, gate)
        y = torch.addcmul(mlp_shift, self.mlp_norm(x), 1 + mlp_scale)
        return torch.addcmul(x, self.mlp(y), mlp_gate), kept

    def keep(self, x: Tensor, past: Tensor, condition: Tensor | None) -> Tensor:
        """The keys and values alone that `forward` returns."""
        y = self.attention_norm(x)
        if self.modulation is not None:
            shift, scale = self.modulation(condition).unsqueeze(-2).chunk(6, -1)[:2]
            y = torch.addcmul(shift, y, 1 + scale)
        return torch.cat([past, F.linear(y, self.qkv.weight[self.inner :])], 1)

    def _attend(self, x: Tensor, past: Tensor, visible: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """Each of T frames attends to the window of H frames that ends with it; also returns keys and values."""
        batch, length, n_patches, _ = x.shape
        n, history = batch * length, past.shape[1] + 1
        query, new = self.qkv(x).split([self.inner, 2 * self.inner], -1)
        kept = torch.cat([past, new], 1)
        # (B, T, H, P, 2 K); of a single frame without unfold, whose gradient is slow
        window = kept.unsqueeze(1) if length == 1 else kept.unfold(1, history, 1).movedim(-1, 2)
        key, value = window.reshape(n, history * n_patches, 2, self.heads, -1).unbind(2)
        key = _rotate(key.unflatten(1, (history, n_patches)), rotation[:, :, None, None]).flatten(1, 2)
        query = query.reshape(n, n_patches, self.heads, -1)
        query, key, value = (t.transpose(1, 2) for t in (query, key, value))
        attended = F.scaled_dot_product_attention(query, key, value, attn_mask=visible)
        return self.out(attended.transpose(1, 2).reshape(batch, length, n_patches, -1)), kept


def _rotate(x: Tensor, rotation: Tensor) -> Tensor:
    """Turn pairs of numbers in the last axis (..., 2 n) by angles whose cosines and sines are given: (2, ..., 2 n)."""
    cosine, sine = rotation
    even, odd = x.unflatten(-1, (-1, 2)).unbind(-1)
    return torch.addcmul(x * cosine, torch.stack([-odd, even], -1).flatten(-2), sine)
