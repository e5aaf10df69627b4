"""A solver of the smoother's windows."""

import gtsam

from fgtrack import BatchBank, BatchSolver


class DoglegSolver(BatchSolver):
    """Solves the whole window from its last estimates by Powell's dogleg."""

    def optimise(self, graph, values):
        return gtsam.DoglegOptimizer(graph, values, gtsam.DoglegParams()).optimize()


class DoglegBank(BatchBank):
    """Fixed-lag smoother whose window Powell's dogleg solves."""

    make_solver = DoglegSolver
