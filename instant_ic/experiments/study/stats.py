"""Scores of questionnaires, and statistics of repeated measures: each participant has a value in each condition."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from instant_ic.experiments.study.plan import Questionnaire

Floats: TypeAlias = NDArray[np.float64]
ALPHA = 0.05
DRAWS = 9999
"""Permutations and bootstrap samples."""


def score(found: Questionnaire, answers: Mapping[str, float]) -> float:
    """Score of a filled questionnaire.

    ``mean``: of all items, reversed ones mirrored in their range (NASA-TLX without weights; agency). ``sus``: 0 to 100,
    odd items count upward, even ones downward, times 2.5 (Brooke, 1996).

    Raises:
        ValueError: the questionnaire has no score.
    """
    if found.score == "sus":
        parts = [answers[one.id] - 1 if n % 2 == 0 else 5 - answers[one.id] for n, one in enumerate(found.items)]
        return 2.5 * sum(parts)
    if found.score != "mean":
        raise ValueError(f"questionnaire {found.id} has no score")
    values = [one.low + one.high - answers[one.id] if one.reverse else answers[one.id] for one in found.items]
    return float(np.mean(values))


@dataclass(frozen=True)
class Friedman:
    """Friedman's test with Kendall's W as its effect size: 0 no agreement on a ranking, 1 complete.

    Attributes:
        chi2: corrected for ties; ``df`` degrees of freedom.
        p: of the chi-square distribution, good for more than about ten participants.
        p_exact: by random permutations within each participant, for any number.
        w: Kendall's W; ``w_low``, ``w_high``: 95 % interval by bootstrap over participants.
    """

    n: int
    chi2: float
    df: int
    p: float
    p_exact: float
    w: float
    w_low: float
    w_high: float


def _chi2(ranks: Floats) -> Floats:
    """Friedman's statistic of ranks (..., n, k), corrected for ties; NaN where all are tied."""
    n, k = ranks.shape[-2:]
    between = n * ((ranks.mean(axis=-2) - (k + 1) / 2) ** 2).sum(axis=-1)
    within = ((ranks - (k + 1) / 2) ** 2).sum(axis=(-2, -1)) / (n * (k - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(between / within)


def friedman(values: Floats, seed: int = 0) -> Friedman | None:
    """Test of (n, k) values of n participants in k conditions; None with fewer than 2 participants or all tied."""
    n, k = values.shape
    if n < 2 or k < 3:
        return None
    ranks = stats.rankdata(values, axis=1)
    chi2 = float(_chi2(ranks))
    if not math.isfinite(chi2):
        return None
    rng = np.random.default_rng([97, seed])
    shuffled = rng.permuted(np.broadcast_to(ranks, (DRAWS, n, k)), axis=2)
    p_exact = (1 + int((_chi2(shuffled) >= chi2 - 1e-9).sum())) / (DRAWS + 1)
    drawn = _chi2(ranks[rng.integers(0, n, (DRAWS, n))]) / (n * (k - 1))
    low, high = np.nanquantile(drawn, (ALPHA / 2, 1 - ALPHA / 2))
    p = float(stats.chi2.sf(chi2, k - 1))
    return Friedman(n, chi2, k - 1, p, p_exact, chi2 / (n * (k - 1)), float(low), float(high))


@dataclass(frozen=True)
class Pair:
    """Wilcoxon's signed-rank test of two conditions.

    Attributes:
        first, second: conditions; differences are first - second.
        shift: Hodges-Lehmann estimate of the difference, ``low`` and ``high`` its 95 % bootstrap interval.
        r: matched-pairs rank-biserial correlation, -1 to 1: the effect size.
        p: two-sided, exact for small samples without ties; ``p_holm``: corrected for the number of pairs.
    """

    first: str
    second: str
    n: int
    shift: float
    low: float
    high: float
    r: float
    p: float
    p_holm: float


def hodges_lehmann(differences: Floats) -> Floats:
    """Median of the means of all pairs of differences (..., n), each with itself too: (...)."""
    i, j = np.triu_indices(differences.shape[-1])
    return np.asarray(np.median((differences[..., i] + differences[..., j]) / 2, axis=-1))


def rank_biserial(differences: Floats) -> float:
    """Share of the rank sum in favour minus that against; zeros are left out; 0 if all are zero."""
    known = differences[differences != 0]
    if not len(known):
        return 0.0
    ranks = stats.rankdata(np.abs(known))
    return float((ranks * np.sign(known)).sum() / ranks.sum())


def pairs(values: Mapping[str, Floats], seed: int = 0) -> list[Pair]:
    """All pairs of conditions; values of the same participants in the same order. Empty below 2 participants."""
    rng = np.random.default_rng([101, seed])
    found = []
    for first, second in itertools.combinations(values, 2):
        differences = values[first] - values[second]
        n = len(differences)
        if n < 2:
            return []
        drawn = hodges_lehmann(differences[rng.integers(0, n, (999, n))])
        low, high = np.quantile(drawn, (ALPHA / 2, 1 - ALPHA / 2))
        p = float(stats.wilcoxon(differences).pvalue) if differences.any() else 1.0
        shift, r = float(hodges_lehmann(differences)), rank_biserial(differences)
        found.append(Pair(first, second, n, shift, float(low), float(high), r, p, p))
    corrected = holm([one.p for one in found])
    return [Pair(**{**vars(one), "p_holm": p}) for one, p in zip(found, corrected, strict=True)]


def holm(p: list[float]) -> list[float]:
    """Holm's correction of p values."""
    corrected, largest = [0.0] * len(p), 0.0
    for place, index in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        largest = max(largest, min(1.0, p[index] * (len(p) - place)))
        corrected[index] = largest
    return corrected


def mean_interval(values: Floats) -> tuple[float, float, float]:
    """Mean, and its 95 % interval by Student's t; NaN limits below 2 values."""
    mean = float(values.mean()) if len(values) else math.nan
    if len(values) < 2:
        return mean, math.nan, math.nan
    half = float(stats.t.ppf(1 - ALPHA / 2, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values)))
    return mean, mean - half, mean + half


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    found = stats.binomtest(count, total).proportion_ci(1 - ALPHA, "wilson")
    return float(found.low), float(found.high)


def least_participants(comparisons: int) -> int:
    """Fewest participants with whom a Wilcoxon test can be significant at all after Holm's correction.

    The smallest two-sided p of n participants is 2 / 2ⁿ, and the smallest of several is multiplied by their number.
    """
    return math.ceil(math.log2(2 * comparisons / ALPHA))
