"""Numbers that were measured; each names the script that finds it again."""

# Samples of an image from which on a control variate reaches plain Monte Carlo's error sooner, training
# included: python bench/bench_method.py.
SAMPLES_THAT_PAY = 3e7
NESTED_SAMPLES_THAT_PAY = 2e6
