"""The default solver: gtsam eliminates the part of each factor graph that has changed, as iSAM2 does.

iSAM2 is Kaess et al., IJRR 31(2), 2012.
"""

from functools import cache

import gtsam
import numpy as np

from fgtrack.core.types import IntArray
from fgtrack.estimation.smoothing import factor_kernels
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.solver import Solver

_unit = cache(gtsam.noiseModel.Unit.Create)
_BLOCK, _NEXT = 0, 1  # keys of the nodes of a block, and of the node after the block
_ORDERING = gtsam.Ordering()
_ORDERING.push_back(_BLOCK)


class IncrementalSolver(Solver):
    """Windows whose factor graphs gtsam eliminates. A compiled loop linearises the factors of all tracks.

    gtsam eliminates the nodes in the order of their stamps, by QR, because Cholesky fails for stamps close together.
    Elimination leaves a conditional of each node, and a factor on the next node, its `INFORMATION`. The Bayes tree
    of a window is this chain of conditionals. A change of a factor leaves all older conditionals as they are. So
    elimination begins at the changed node, with its `INFORMATION`. Up to four nodes are eliminated at once, and only
    the first node of such a block keeps its `INFORMATION`. The oldest node of a window has that of its prior.

    The means come from the conditionals. The covariances come from the elimination of `Solver`, which takes the same
    linearised factors. A checkpoint has all of it, because it is in the arrays of the nodes.
    """

    def _solve_graphs(
        self, tracks: IntArray, starts: IntArray, firsts: IntArray
    ) -> None:
        """See `Solver._solve_graphs`. Means then come from gtsam."""
        try:
            self._eliminate(tracks, starts, firsts)
        except (RuntimeError, ValueError, IndexError) as error:
            raise np.linalg.LinAlgError(
                f"the graph cannot be solved ({error})"
            ) from error

    def _eliminate(self, tracks: IntArray, starts: IntArray, firsts: IntArray) -> None:
        """Eliminate the nodes whose factors have changed, and write the steps of the windows.

        Raises `RuntimeError`, `ValueError` or `IndexError` if this fails.
        """
        nodes, n, begins = self.nodes, self.motion.dim, np.empty_like(starts)
        num = factor_kernels.find_begins(tracks, starts, firsts, nodes.arrays, begins)
        most_nodes, num_rows = factor_kernels.MOST_NODES, n + nodes.rows.shape[1]
        width = (most_nodes + 1) * n + 1
        sizes = np.empty((num, 3), dtype=np.int64)
        factors = np.empty((num, n + most_nodes * num_rows, width))
        if not factor_kernels.write_factors(
            tracks, begins, firsts, nodes.arrays, sizes, factors
        ):
            raise ValueError("a covariance is not positive definite")
        conditionals = np.empty((num, most_nodes * n, width))
        information = np.empty((num, n, n + 1))
        left = None
        for factor, conditional, own_information, (
            num_rows,
            num_nodes,
            has_next,
        ) in zip(factors, conditionals, information, sizes.tolist(), strict=True):
            own = num_nodes * n
            if left is not None:
                factor[:n, :n], factor[:n, -1] = left[:, :-1], left[:, -1]
            A, b = factor[:num_rows, :own], factor[:num_rows, -1]
            if not has_next:
                solved, left = gtsam.JacobianFactor(_BLOCK, A, b, _unit(num_rows)), None
                matrix = solved.eliminate(_ORDERING)[0].augmentedJacobianUnweighted()
            else:
                B = factor[:num_rows, own : own + n]
                joint = gtsam.JacobianFactor(_BLOCK, A, _NEXT, B, b, _unit(num_rows))
                given, rest = joint.eliminate(_ORDERING)
                matrix, left = (
                    given.augmentedJacobianUnweighted(),
                    rest.augmentedJacobianUnweighted(),
                )
                own_information[:] = left
            conditional[:own, : matrix.shape[1] - 1] = matrix[:, :-1]
            conditional[:own, -1] = matrix[:, -1]
        if not factor_kernels.read_conditionals(
            tracks, begins, nodes.arrays, conditionals, information
        ):
            raise ValueError("a state is not finite")


class IncrementalBank(SmootherBank):
    """Fixed-lag smoother, a factor graph that gtsam eliminates incrementally."""

    make_solver = IncrementalSolver
    rounding = 1.0
