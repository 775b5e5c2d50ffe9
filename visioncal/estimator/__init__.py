"""The estimator: residuals with analytic Jacobians, normal equations, and what they can tell."""
