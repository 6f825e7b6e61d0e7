"""The schedule of a training."""

from __future__ import annotations

from dataclasses import dataclass

from . import tuning


@dataclass(frozen=True)
class Schedule:
    """How a network is trained.

    Attributes
    ----------
    batch : int
        Training points a minibatch, about.
    samples_a_step : int
        Samples of each of them that one Adam step sees; heads are paid once for all of these.
    epochs : int
        How often each stored sample is used.
    rate, final_rate : float
        Adam's step size at first and, after a cosine decay, at last.
    beta1, beta2, epsilon : float
        Adam's constants.
    table_rate : float
        Step size of the hash grid's table as a multiple of the network's.
    table_beta2 : float
        Weight of the past in the second moment of a table entry.
    table_adam : bool
        Whether the table is stepped as the network is, by both moments of every feature, instead of by
        one second moment an entry.
    average_decay : float
        Weight of the past in the moving average of the network's parameters, which is what is used.
    weight_power : float
        Demodulated networks: samples weigh as this power of the point's factor.
    """

    batch: int = tuning.BATCH
    samples_a_step: int = tuning.SAMPLES_A_STEP
    epochs: int = tuning.EPOCHS
    rate: float = tuning.RATE
    final_rate: float = tuning.FINAL_RATE
    beta1: float = tuning.BETA1
    beta2: float = tuning.BETA2
    epsilon: float = 1e-8
    table_rate: float = tuning.TABLE_RATE
    table_beta2: float = tuning.TABLE_BETA2
    table_adam: bool = False
    average_decay: float = tuning.AVERAGE_DECAY
    weight_power: float = tuning.WEIGHT_POWER
