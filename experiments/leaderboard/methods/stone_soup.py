"""Stone Soup as `fgtrack rank` takes it: sorting, accumulated state densities, and its examples for late data."""

from datetime import datetime, timedelta

import numpy as np
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
from stonesoup.models.transition.linear import (
    CombinedLinearGaussianTransitionModel,
    ConstantVelocity,
)
from stonesoup.predictor.asd import ASDKalmanPredictor
from stonesoup.predictor.kalman import (
    ExtendedKalmanPredictor,
    UnscentedKalmanPredictor,
)
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.numeric import Probability
from stonesoup.types.particle import Particle
from stonesoup.types.state import (
    ASDGaussianState,
    GaussianState,
    ParticleState,
    State,
)
from stonesoup.updater.asd import ASDKalmanUpdater
from stonesoup.updater.kalman import ExtendedKalmanUpdater, UnscentedKalmanUpdater
from stonesoup.updater.particle import ParticleUpdater

EPOCH = datetime(2024, 1, 1)
#: Stone Soup's order x, vx, y, vy of the states x, y, vx, vy, and back.
ORDER = [0, 2, 1, 3]
BUFFERED = 5
#: Number of particles, their standard deviations after a late detection, and the seed: those of the example.
NUM_PARTICLES, SPREAD, SEED = 256, np.diag([10.0, 1.0, 10.0, 1.0]), 1908


def at(time_s):
    return EPOCH + timedelta(seconds=time_s)


def answer(mean, covariance):
    x, P = np.array(mean, float).ravel(), np.array(covariance, float)
    return x[ORDER], P[np.ix_(ORDER, ORDER)]


def transition_model(given):
    if given.motion != "cv":
        raise NotImplementedError("Stone Soup has no such turn model")
    density = given.parameters["velocity_density_m2ps3"]
    return CombinedLinearGaussianTransitionModel([ConstantVelocity(density)] * 2)


def detection(observation, time_s):
    """Return the observation as a detection with its measurement model, and the stamp `time_s`."""
    names, z, R = tuple(observation.values), observation.z, observation.R
    if names == ("x_m", "y_m"):
        model = LinearGaussian(4, (0, 2), R)
    elif names == ("range_m", "bearing_rad"):
        model, z = CartesianToBearingRange(4, (0, 2), R[::-1, ::-1]), z[::-1]
    else:
        raise NotImplementedError("the adapter has no range rate")
    return Detection(z[:, None], timestamp=at(time_s), measurement_model=model)


class _Filter:
    """An extended Kalman filter that goes forward in time."""

    def __init__(self, given):
        self.predictor = ExtendedKalmanPredictor(transition_model(given))
        self.updater = ExtendedKalmanUpdater(None)
        P = given.covariance[np.ix_(ORDER, ORDER)]
        self.prior = GaussianState(given.mean[ORDER], P, timestamp=EPOCH)
        self.state = self.prior

    def fused(self, state, one):
        predicted = self.predictor.predict(state, timestamp=one.timestamp)
        return self.updater.update(SingleHypothesis(predicted, one))

    def state_at(self, time_s):
        state = self.predictor.predict(self.state, timestamp=at(time_s))
        return answer(state.state_vector, state.covar)


class Sorted(_Filter):
    """What a careful user does: all detections are sorted and filtered anew."""

    def __init__(self, given):
        super().__init__(given)
        self.known = []

    def update(self, observation):
        self.known.append(detection(observation, observation.stamp_s))

    def state_at(self, time_s):
        self.state = self.prior
        for one in sorted(self.known, key=lambda one: one.timestamp):
            if one.timestamp <= at(time_s):
                self.state = self.fused(self.state, one)
        return super().state_at(time_s)


class AtArrival(_Filter):
    """Tracker 1 of the example "Kalman filter with out-of-sequence measurements": the stamp is the arrival."""

    def update(self, observation):
        one = detection(observation, observation.receipt_s)
        self.state = self.fused(self.state, one)


class Buffered(_Filter):
    """The example with a fixed lag storage: of five waiting detections, the oldest is released."""

    def __init__(self, given):
        super().__init__(given)
        self.waiting = []

    def update(self, observation):
        if len(self.waiting) == BUFFERED:
            self.waiting.sort(key=lambda one: one.timestamp)
            self.state = self.fused(self.state, self.waiting.pop(0))
        self.waiting.append(detection(observation, observation.stamp_s))


class InverseTime(_Filter):
    """The example of inverse-time dynamics: a late detection becomes a pseudo-detection at the newest stamp.

    The state behind the detection has no velocity, so its position does not move.
    """

    def __init__(self, given):
        super().__init__(given)
        self.predictor = UnscentedKalmanPredictor(transition_model(given))
        self.updater = UnscentedKalmanUpdater(None)

    def update(self, observation):
        one = detection(observation, observation.stamp_s)
        if one.timestamp < self.state.timestamp:
            one = self.moved(one, self.state.timestamp)
        self.state = self.fused(self.state, one)

    def moved(self, one, timestamp):
        model = one.measurement_model
        if isinstance(model, LinearGaussian):
            place = model.matrix().T @ one.state_vector
        else:
            place = model.inverse_function(one)
        place = self.predictor.transition_model.function(
            State(place), noise=False, time_interval=timestamp - one.timestamp
        )
        z = model.function(State(place), noise=False)
        return Detection(z, timestamp=timestamp, measurement_model=model)


class Particles:
    """The example of a particle filter: the particles of a late detection enter the track before the newest ones.

    The filter goes on from the newest ones, so a late detection has no effect on the present.
    """

    def __init__(self, given):
        np.random.seed(SEED)  # noqa: NPY002 (Stone Soup draws from it)
        self.given = given
        self.predictor = ParticlePredictor(transition_model(given))
        self.resampler = ESSResampler()
        self.updater = ParticleUpdater(None, resampler=self.resampler)
        P = given.covariance[np.ix_(ORDER, ORDER)]
        self.state = self.drawn(given.mean[ORDER], P, EPOCH)
        self.track = [self.state]

    def drawn(self, mean, covariance, timestamp):
        rng = np.random.default_rng(SEED)
        samples = rng.multivariate_normal(mean, covariance, NUM_PARTICLES)
        particles = [Particle(each[:, None], Probability(1.0)) for each in samples]
        return ParticleState(None, particle_list=particles, timestamp=timestamp)

    def update(self, observation):
        one = detection(observation, observation.stamp_s)
        is_late = one.timestamp <= self.track[-1].timestamp
        before, state = len(self.track) - 1, self.state
        if is_late:
            gaps = [abs(each.timestamp - one.timestamp) for each in self.track]
            before = int(np.argmin(gaps))
            near = self.track[before]
            mean = np.asarray(near.state_vector, float).mean(axis=1)
            state = self.drawn(mean, SPREAD, near.timestamp)
        predicted = self.predictor.predict(state, timestamp=one.timestamp)
        updated = self.updater.update(SingleHypothesis(predicted, one))
        self.track.insert(before + 1, updated)
        newest = self.track[-1]
        self.state = self.resampler.resample(newest) if is_late else newest

    def state_at(self, time_s):
        dt_s = time_s - (self.state.timestamp - EPOCH).total_seconds()
        if dt_s < 0.0:
            return None
        F, Q = self.given.transition(dt_s)
        x, P = answer(self.state.mean, self.state.covar)
        return F @ x, F @ P @ F.T + Q


class Accumulated:
    """Accumulated state densities: ASDKalmanPredictor and ASDKalmanUpdater."""

    def __init__(self, given):
        self.predictor = ASDKalmanPredictor(transition_model(given))
        self.updater = ASDKalmanUpdater(None)
        P = given.covariance[np.ix_(ORDER, ORDER)]
        self.state = ASDGaussianState(
            given.mean[ORDER], timestamps=[EPOCH], multi_covar=P, max_nstep=0
        )

    def update(self, observation):
        one = detection(observation, observation.stamp_s)
        if not isinstance(one.measurement_model, LinearGaussian):
            raise NotImplementedError("accumulated state densities are linear")
        predicted = self.predictor.predict(self.state, timestamp=one.timestamp)
        self.state = self.updater.update(SingleHypothesis(predicted, one))

    def state_at(self, time_s):
        state = self.state
        if at(time_s) not in state.timestamps:
            state = self.predictor.predict(state, timestamp=at(time_s))
        k = state.timestamps.index(at(time_s))
        rows = slice(4 * k, 4 * k + 4)
        return answer(state.multi_state_vector[rows], state.multi_covar[rows, rows])
