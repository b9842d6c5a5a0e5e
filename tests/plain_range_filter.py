"""The range filter in plain numpy matrices, as paper B (23)-(29) reads: what the compiled one is held against."""

import numpy as np

H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def flow(x, omega, speed, dt, focal, centre):
    """A fixed point in the camera's axes, turned and shifted by the arc, and projected again."""
    z = 1 / x[2]
    point = np.array([(x[0] - centre[0]) / focal * z, (x[1] - centre[1]) / focal * z, z])
    turn = omega * dt
    s = dt if turn == 0 else np.sin(turn) / omega
    c = 0.0 if turn == 0 else (1 - np.cos(turn)) / omega
    x1 = np.cos(turn) * point[0] - np.sin(turn) * point[2] + speed * c
    z1 = np.sin(turn) * point[0] + np.cos(turn) * point[2] - speed * s
    return np.array([focal * x1 / z1 + centre[0], focal * point[1] / z1 + centre[1], 1 / z1])


def derivative(function, at, steps):
    """Central differences, one column a parameter."""
    columns = []
    for i, step in enumerate(steps):
        up, down = np.array(at, float), np.array(at, float)
        up[i] += step
        down[i] -= step
        columns.append((function(up) - function(down)) / (2 * step))
    return np.stack(columns, axis=-1)


def step(x, P, omega, speed, dt, z, R, Q, focal, centre, a, g, gate=np.inf):
    """(23)-(27) with Joseph's form; A and G are given. Returns X⁻, P⁻, ν, S, K, NIS, X, P."""
    ahead = flow(x, omega, speed, dt, focal, centre)
    P = a @ P @ a.T + g @ (Q / dt) @ g.T
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    nu = z - H @ ahead
    nis = nu @ np.linalg.solve(S, nu)
    if nis > gate:
        return ahead, P, nu, S, K, nis, ahead, P
    left = np.eye(3) - K @ H
    return ahead, P, nu, S, K, nis, ahead + K @ nu, left @ P @ left.T + K @ R @ K.T
