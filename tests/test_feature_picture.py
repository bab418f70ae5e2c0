import numpy as np
import torch

from lerobot_latentsafe.encoders.patch_encoders import load_encoder
from lerobot_latentsafe.experiments.bag.features import draw_features, principal_colours, see_variants
from lerobot_latentsafe.franka.bag import VARIANTS
from lerobot_latentsafe.reports.figures import save


def test_equal_tokens_have_equal_colours_and_different_ones_do_not():
    tokens = torch.randn(3, 20, 8)
    tokens[1] = tokens[0]
    colours = principal_colours(tokens)
    assert colours.shape == (3, 20, 3) and colours.min() >= 0 and colours.max() <= 1
    torch.testing.assert_close(colours[0], colours[1])
    assert (colours[0] - colours[2]).abs().mean() > 0.05


def test_every_variant_is_drawn_from_both_cameras(tmp_path):
    seen = see_variants(32, "closed_end", step=1, seed=0)
    assert list(seen) == list(VARIANTS)
    assert all(pair.shape == (2, 32, 32, 3) and pair.dtype == np.uint8 for pair in seen.values())
    figure = draw_features(load_encoder("efficientnet_lite0"), seen)
    assert [axis.get_title() for axis in figure.axes if axis.get_title()] == list(VARIANTS)
    save(figure, tmp_path / "features.png")
    assert (tmp_path / "features.png").stat().st_size > 10_000
