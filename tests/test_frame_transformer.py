"""Frame by frame equals all at once, however far the window slides."""

import pytest
import torch

from lerobot_latentsafe.world_models.frame_transformer import ROTARY_BASE, FrameTransformer

B, T, P, D, H, HEADS, HEAD_DIM = 2, 11, 5, 12, 3, 2, 8


@pytest.fixture(params=[None, 6], ids=["plain", "conditioned"])
def transformer(request):
    model = FrameTransformer(D, 3, HEADS, HEAD_DIM, 24, H, request.param).eval()
    for block in model.blocks:
        if block.modulation is not None:  # starts at zero, where every condition is alike
            torch.nn.init.normal_(block.modulation.weight, std=0.2)
    return model


def inputs(transformer):
    conditioned = transformer.blocks[0].modulation is not None
    seen = torch.arange(1, T + 1).expand(B, T)
    return torch.randn(B, T, P, D), seen, torch.randn(B, T, 6) if conditioned else None


def streamed(transformer, x, seen, condition):
    past, rows = None, []
    for t in range(x.shape[1]):
        now = slice(t, t + 1)
        y, kept = transformer(x[:, now], seen[:, now], past, None if condition is None else condition[:, now])
        past = [k[:, 1:] for k in kept]
        rows.append(y)
    return torch.cat(rows, 1)


@torch.no_grad()
def test_streaming_equals_the_full_forward_beyond_the_window(transformer):
    x, seen, condition = inputs(transformer)
    whole, _ = transformer(x, seen, None, condition)
    torch.testing.assert_close(streamed(transformer, x, seen, condition), whole, atol=1e-5, rtol=0)


@torch.no_grad()
def test_the_future_and_what_lies_beyond_every_layers_window_do_not_matter(transformer):
    x, seen, condition = inputs(transformer)
    other = x.clone()
    other[:, 0], other[:, 9:] = 5.0, -5.0
    a, b = (transformer(z, seen, None, condition)[0] for z in (x, other))
    reach = 3 * (H - 1)  # three layers, each two frames back
    torch.testing.assert_close(a[:, reach + 1 : 9], b[:, reach + 1 : 9])
    assert not torch.allclose(a[:, reach], b[:, reach])


@torch.no_grad()
def test_frames_not_seen_do_not_matter(transformer):
    x, _, condition = inputs(transformer)
    seen = torch.tensor([1, 2, 3, 1, 2, 3, 3, 1, 2, 3, 3]).expand(B, T)  # new episodes at 3 and 7
    other = torch.where((torch.arange(T) < 7)[:, None, None], torch.randn_like(x), x)
    a, b = (transformer(z, seen, None, condition)[0] for z in (x, other))
    torch.testing.assert_close(a[:, 7:], b[:, 7:])
    assert a.isfinite().all()


@torch.no_grad()
def test_one_layer_is_banded_attention_with_keys_and_queries_turned_by_their_time():
    """The same written as the textbook has it: absolute rotations, a dense mask, one softmax."""
    model = FrameTransformer(D, 1, HEADS, HEAD_DIM, 24, H).eval()
    x, block = torch.randn(B, T, P, D), model.blocks[0]
    query, key, value = block.qkv(block.attention_norm(x)).view(B, T, P, 3, HEADS, HEAD_DIM).unbind(3)
    angle = torch.arange(T)[:, None] * ROTARY_BASE ** (-torch.arange(0, HEAD_DIM, 2) / HEAD_DIM)
    turn = lambda z: torch.view_as_real(  # noqa: E731
        torch.view_as_complex(z.unflatten(-1, (-1, 2)).contiguous())
        * torch.polar(torch.ones(()), -angle)[:, None, None]
    ).flatten(-2)
    score = torch.einsum("btphd,bsqhd->bhtpsq", turn(query), turn(key)) / HEAD_DIM**0.5
    apart = torch.arange(T)[:, None] - torch.arange(T)
    hidden = (apart < 0) | (apart >= H)
    score = score.masked_fill(hidden[:, None, :, None], -torch.inf).flatten(-2).softmax(-1)
    attended = torch.einsum("bhtpk,bkhd->btphd", score, value.flatten(1, 2)).flatten(-2)
    y = x + block.out(attended)
    expected = model.norm(y + block.mlp(block.mlp_norm(y)))
    seen = torch.arange(1, T + 1).expand(B, T)
    torch.testing.assert_close(model(x, seen)[0], expected)
