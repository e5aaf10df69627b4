"""The default solver: gtsam eliminates the part of each factor graph that has changed, as iSAM2 does.

iSAM2 is Kaess et al., IJRR 31(2), 2012.
"""

from functools import cache
from itertools import pairwise

import gtsam
import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing import factor_kernels
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.node_arrays import INFORMATION
from fgtrack.estimation.smoothing.solver import Solver

_unit = cache(gtsam.noiseModel.Unit.Create)


@cache
def _ordering(number: int) -> gtsam.Ordering:
    """Return the elimination order of one node."""
    ordering = gtsam.Ordering()
    ordering.push_back(number)
    return ordering


class IncrementalSolver(Solver):
    """Windows whose factor graphs gtsam eliminates. A compiled loop linearises the factors of all tracks.

    The variables of a graph have the numbers of the nodes. gtsam eliminates them in the order of their stamps, by QR,
    because Cholesky fails for stamps close together. Elimination leaves a conditional of the node, and a factor
    on the next node, its `INFORMATION`. The Bayes tree of a window is this chain of conditionals. A change of a
    factor therefore leaves all older conditionals as they are: elimination begins at the changed node, with its
    `INFORMATION`. The oldest node of a window has the `INFORMATION` of its prior.

    The means come from the conditionals. The covariances come from the elimination of `Solver`, which takes the same
    linearised factors.
    """

    def _solve_graphs(
        self, tracks: IntArray, starts: IntArray, firsts: IntArray
    ) -> None:
        """See `Solver._solve_graphs`. Means then come from gtsam."""
        try:
            self._eliminate(tracks, np.maximum(starts - 1, firsts), firsts)
        except (RuntimeError, ValueError, IndexError) as error:
            raise np.linalg.LinAlgError(
                f"the graph cannot be solved ({error})"
            ) from error

    def _eliminate(self, tracks: IntArray, begins: IntArray, firsts: IntArray) -> None:
        """Eliminate the nodes from the indices `begins` on, and write the steps of the windows.

        The windows began at `firsts` before. Raises `RuntimeError`, `ValueError` or `IndexError` if this fails.
        """
        nodes, n = self.nodes, self.motion.dim
        counts = nodes.count[tracks] - begins
        total = int(counts.sum())
        sizes = np.empty(total, dtype=np.int64)
        factors = np.empty((total, n + nodes.rows.shape[1], 2 * n + 1))
        if not factor_kernels.write_factors(
            tracks, begins, firsts, nodes.arrays, sizes, factors
        ):
            raise ValueError("a covariance is not positive definite")
        inner, newest, information = list[FloatArray](), [], list[FloatArray]()
        matrices = zip(factors, sizes.tolist(), strict=True)
        for row, begin, count in zip(
            nodes.numbers[tracks], begins.tolist(), counts.tolist(), strict=True
        ):
            numbers = row[begin : begin + count].tolist()
            left = self._information(numbers[0])
            for number, following in pairwise(numbers):
                each, size = next(matrices)
                graph = gtsam.GaussianFactorGraph()
                graph.push_back(left)
                graph.push_back(
                    gtsam.JacobianFactor(
                        number,
                        each[:size, :n],
                        following,
                        each[:size, n:-1],
                        each[:size, -1],
                        _unit(size),
                    )
                )
                conditional, left = gtsam.EliminateQR(graph, _ordering(number))
                inner.append(conditional.augmentedJacobianUnweighted())
                information.append(left.augmentedJacobianUnweighted())
            graph, number = gtsam.GaussianFactorGraph(), numbers[-1]
            graph.push_back(left)
            each, size = next(matrices)
            if size:
                own = each[:size]
                graph.push_back(
                    gtsam.JacobianFactor(number, own[:, :n], own[:, -1], _unit(size))
                )
            conditional, _ = gtsam.EliminateQR(graph, _ordering(number))
            newest.append(conditional.augmentedJacobianUnweighted())
        if not factor_kernels.read_conditionals(
            tracks,
            begins,
            nodes.arrays,
            _stacked(inner, n, 2 * n + 1),
            _stacked(newest, n, n + 1),
            _stacked(information, n, n + 1),
        ):
            raise ValueError("a state is not finite")

    def _information(self, number: int) -> gtsam.JacobianFactor:
        """Return the factor that all older factors leave on a node."""
        matrix = self.nodes.blocks[number, INFORMATION]
        return gtsam.JacobianFactor(
            number, matrix[:, :-1], matrix[:, -1], _unit(len(matrix))
        )


def _stacked(matrices: list[FloatArray], *shape: int) -> FloatArray:
    """Return `matrices` as one array, shape (m, *shape)."""
    return np.array(matrices, dtype=np.float64, order="C").reshape(-1, *shape)


class IncrementalBank(SmootherBank):
    """Fixed-lag smoother, a factor graph that gtsam eliminates incrementally."""

    make_solver = IncrementalSolver
    rounding = 1.0
