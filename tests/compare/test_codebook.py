"""Type I codebook."""

import numpy as np
import pytest

from aerpaw_cmp.compare.codebook import codebook_rank, codebook_rates, precoders


@pytest.mark.parametrize(("layers", "count"), [(1, 32), (2, 32), (3, 16), (4, 16)])
def test_precoders_have_orthogonal_layers_and_unit_power(layers, count):
    w = precoders(layers)
    assert w.shape == (count, 4, layers)
    gram = np.conj(np.swapaxes(w, 1, 2)) @ w
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(layers) / layers, gram.shape), atol=1e-12)


def test_rank_one_channel_carries_one_layer_and_a_rich_one_four():
    line = np.outer(np.ones(4), np.conj(precoders(1)[5, :, 0]))
    rich = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    rates = codebook_rates(np.stack([line, rich, rich]), [30.0, 40.0, -20.0], order=(0, 1, 2, 3))
    assert codebook_rank(rates).tolist()[:2] == [1, 4]
    # matched beam: the whole array gain, log2(1 + snr n_rx n_tx)
    assert rates[0, 0] == pytest.approx(np.log2(1 + 1e3 * 16), rel=1e-9)
    assert codebook_rank(rates, cap_bits=np.inf, penalty_bits=100.0).tolist() == [1, 1, 1]


def test_all_layers_are_no_more_than_the_capacity():
    rng = np.random.default_rng(2)
    h = rng.normal(size=(50, 4, 4, 2)) @ [1, 1j]
    rates = codebook_rates(h, np.full(50, 15.0))
    s2 = np.linalg.svd(h, compute_uv=False) ** 2
    snr = 10**1.5 * 16 / s2.sum(axis=1)
    level = (snr[:, None, None] * s2[:, :, None] * np.linspace(0, 1, 3)).max(axis=2)
    assert (rates.max(axis=1) <= np.log2(1 + level).sum(axis=1) + 1e-9).all()


def test_no_channel_or_no_sinr_is_rank_zero():
    rates = codebook_rates(np.stack([np.zeros((4, 4)), np.eye(4)]), [10.0, np.nan])
    assert codebook_rank(rates).tolist() == [0, 0]
