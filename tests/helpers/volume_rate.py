"""The rate of V_v along a motion, from its partial derivatives."""


def volume_rate(volume, state_rate, known, disturbance):
    """Returns dV_v/dt when the disturbance is known (E60) [1/s].

    Args:
        volume: V_v and its derivatives.
        state_rate: dx/dt under the input and the disturbance, shape (n,).
        known: What the observer says.
        disturbance: The true disturbance, shape (q,).
    """
    estimate_rate = known.rate + known.gain * (disturbance - known.estimate)
    return float(
        volume.state @ state_rate
        + volume.time
        + volume.estimate @ estimate_rate
        + volume.bound * known.bound_rate
    )
