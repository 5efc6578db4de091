"""What chains are compared with: the reference solutions agree with each other and with closed forms."""

import numpy as np
import pytest

from multilift_marl.physical import GRAVITY
from multilift_marl.validation.cables import second_order
from multilift_marl.validation.chains import exponential, inclined_chains, straight_chain

TIMES = 5e-4 * np.arange(1, 101)


def test_exponential_of_a_rotation_and_of_a_stiff_decay():
    c, s = np.cos(3.0), np.sin(3.0)
    np.testing.assert_allclose(exponential(np.array([[0, -3.0], [3.0, 0]])), [[c, -s], [s, c]], atol=1e-13)
    np.testing.assert_allclose(exponential(np.diag([-1e6, -0.5])), np.diag([0, np.exp(-0.5)]), atol=1e-12)


@pytest.mark.parametrize("mass", [0.1, 1.0, 60.0])
def test_an_upright_chain_is_solved_alike_by_matrix_exponential_and_midpoint_rule(mass):
    exact = straight_chain(mass, 1e5, 1e3, GRAVITY, TIMES)
    stepped = inclined_chains(mass, 1e5, 1e3, 1, 0.0, TIMES)
    assert np.abs(stepped - exact).max() < 2e-4 * mass * GRAVITY / 1e5


def test_the_midpoint_rule_converges_with_the_square_of_its_step():
    coarse, fine, finest = (
        inclined_chains(6.0, 1e5, 1e3, 6, np.pi / 6, TIMES[:40], step) for step in (1e-4, 5e-5, 2.5e-5)
    )
    ratio = np.linalg.norm(coarse - fine) / np.linalg.norm(fine - finest)
    assert ratio == pytest.approx(4.0, rel=0.2)


def test_a_heavy_load_on_a_chain_moves_as_on_one_spring():
    chain, spring = straight_chain(60.0, 1e5, 1e3, GRAVITY, TIMES), second_order(60.0, 1e5, 1e3, TIMES)
    assert np.abs(chain - spring).max() < 1e-3 * 60 * GRAVITY / 1e5


def test_a_light_load_leaves_inclined_chains_sagging():
    sagging = inclined_chains(0.6, 1e5, 1e3, 6, np.pi / 6, TIMES)
    taut = straight_chain(0.6 / (6 * np.cos(np.pi / 6) ** 2), 1e5, 1e3, GRAVITY * np.cos(np.pi / 6), TIMES)
    assert np.abs(sagging - taut / np.cos(np.pi / 6)).max() > 0.05 * np.abs(sagging).max()
