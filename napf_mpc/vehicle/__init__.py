"""The quadrotor: nonlinear model, linearisation, LQR, and the plant that flies (Eq. 1-13)."""
