"""The estimate of an image: method, allocation, passes, calibrated variances."""
