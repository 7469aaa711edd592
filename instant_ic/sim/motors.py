"""Track motors under the speed loops of the controller, with power, current and encoders.

With a healthy encoder, a track follows its set point with a lag and a limited acceleration. The loop regulates the
counted motion: motion that the encoder does not count is an error, which the loop integrates (wind-up) until the power
saturates. With a dead encoder the track therefore runs away, and with a reversed one it does so at once.
"""

import math

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

FULL_SPEED_M_S = 1.0
"""Speed of a track at full power and nominal voltage, without load."""
NOMINAL_V = 24.0
STALL_A = 30.0
"""Current of a blocked motor at full power and nominal voltage."""
_NOISE_A = 0.05
_STANDS_M_S = 1e-3


class TrackMotors:
    """Motors of the left and the right track.

    Args:
        acceleration: largest acceleration that the motor gives a track, m/s².
        lag_s: time constant with which a track follows its set point, seconds.
        resistance: deceleration of a track by friction, m/s².
        seed: seed of the noise of the currents.

    Attributes:
        speeds: track speeds, m/s, (2,).
        travelled: distances of the tracks since the start, metres, (2,).
        counted: distances that the encoders counted, metres, (2,).
        power: share of full power that each motor gets, -1 to 1, (2,).
        currents_a: currents that the controller measures, amperes, (2,).
        encoders: counted share of each track's motion, (2,): 1 healthy, 0 dead, -1 reversed.
        blocked: True for a track that is held fast, (2,).
        load: power that each track needs beyond that of a free run, (2,).
        stiction: power below which a standing track does not start, (2,).
        battery_v: voltage of the main battery.
        gain, integral_gain: gains of the speed loop, m/s per m/s and m/s per metre.
    """

    def __init__(self, acceleration: float, lag_s: float, resistance: float, seed: int = 0) -> None:
        self.acceleration, self.lag_s, self.resistance = acceleration, lag_s, resistance
        self.speeds: FloatArray = np.zeros(2)
        self.travelled: FloatArray = np.zeros(2)
        self.counted: FloatArray = np.zeros(2)
        self.power: FloatArray = np.zeros(2)
        self.currents_a: FloatArray = np.zeros(2)
        self.encoders: FloatArray = np.ones(2)
        self.blocked: npt.NDArray[np.bool_] = np.zeros(2, bool)
        self.load: FloatArray = np.zeros(2)
        self.stiction: FloatArray = np.zeros(2)
        self.battery_v = NOMINAL_V
        self.gain, self.integral_gain = 2.0, 30.0
        self._healthy: FloatArray = np.zeros(2)  # speeds of healthy tracks without load
        self._integral: FloatArray = np.zeros(2)
        self._rng = np.random.default_rng([37, seed])

    def step(self, setpoint_m_s: FloatArray, dt_s: float, closed_loop: bool = True) -> FloatArray:
        """Advance the motors.

        Args:
            setpoint_m_s: set points of the speed loops (2,); with ``closed_loop`` False the speeds without load that
                the power would give.
            dt_s: duration of the step in seconds.
            closed_loop: True while the speed loops regulate.

        Returns:
            Mean speeds of the tracks during the step, m/s, (2,).
        """
        top = FULL_SPEED_M_S * self.battery_v / NOMINAL_V
        before, driven = self.speeds, setpoint_m_s
        if closed_loop:
            self._healthy = self._follow(self._healthy, setpoint_m_s, dt_s)
            error = self._healthy - self.encoders * self.speeds
            self._integral = np.clip(self._integral + self.integral_gain * error * dt_s, -top, top)
            driven = setpoint_m_s + self.gain * error + self._integral
        driven = np.clip(driven, -top, top)
        moving = np.abs(self.speeds) > _STANDS_M_S
        resisted = driven - np.sign(np.where(moving, self.speeds, driven)) * np.minimum(self.load, np.abs(driven))
        stuck = self.blocked | (~moving & (np.abs(driven) < self.stiction))
        self.speeds = np.where(stuck, 0.0, self._follow(before, np.where(stuck, 0.0, resisted), dt_s))
        if not closed_loop:
            self._healthy, self._integral = self.speeds, np.zeros(2)
        mean = 0.5 * (before + self.speeds)
        self.travelled = self.travelled + mean * dt_s
        self.counted = self.counted + self.encoders * mean * dt_s
        friction = self.resistance * self.lag_s
        self.power = np.clip((driven + np.sign(driven) * friction) / top, -1.0, 1.0)
        stalled = self.power * self.battery_v / NOMINAL_V - self.speeds / FULL_SPEED_M_S
        noise = _NOISE_A * self._rng.standard_normal(2)
        self.currents_a = np.where(self.power == 0.0, 0.0, STALL_A * stalled + noise)
        return mean

    def _follow(self, speeds: FloatArray, wanted: FloatArray, dt_s: float) -> FloatArray:
        """Return the speeds of tracks after following ``wanted`` for ``dt_s``; at zero, friction ends the motion."""
        most = self.acceleration * dt_s
        follow = (wanted - speeds) * (1 - math.exp(-dt_s / self.lag_s))
        followed = speeds + np.clip(follow, -most, most)
        braked = np.sign(followed) * np.maximum(np.abs(followed) - self.resistance * dt_s, 0.0)
        return np.where(wanted == 0, braked, followed)
