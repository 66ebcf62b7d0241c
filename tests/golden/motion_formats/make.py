#!/usr/bin/env python3
"""Golden files for the formats of the field, written as their programs write them, with forward kinematics
stated apart from the readers.

    python3 make.py            (numpy and scipy; run in any directory; seed 31, fixed)

All motion is drawn: sums of slow sines, no data of anyone's. Written beside this script:

  aist.npz            smpl_poses [271, 72], smpl_trans, smpl_scaling 93.7; 60 fps, +Y up
  amass.npz           poses [373, 156] float32, trans, mocap_framerate 120, gender (string), an object; +Z up
  smplx.npz           poses [151, 165], trans, mocap_frame_rate 50; +Z up
  smpl.npz            poses [131, 24, 3], trans, fps 24; +Y up as the body is carried
  humanml3d.npy       [61, 263] float32, features made from joint positions
  lafan1.bvh          its hierarchy: bones along +X, root offset in the room, Z-Y-X rotations, centimetres, 30 fps
  bandai.bvh          its hierarchy: joint_Root that never moves, six channels on every joint, centimetres, 30 fps
  dance.vmd           keys of the three root bones and of another, curves of all kinds
  camera.vmd          keys of the camera
  <name>.expected.npy [T, 25] float64, before rounding to single precision

Filter, resampling, derivatives and style are those of ../motion/make.py, whose frames these are.
"""

import importlib.util
import pathlib
import struct

import numpy as np
import scipy
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation, Slerp

HERE = pathlib.Path(__file__).resolve().parent
SEED = 31
FPS = 30.0
# Rest position of the pelvis of SMPL's neutral mean shape, m.
MEAN_PELVIS = np.array([-0.00179506, -0.22333382, 0.02821918])

spec = importlib.util.spec_from_file_location("captures", HERE.parent / "motion" / "make.py")
captures = importlib.util.module_from_spec(spec)
spec.loader.exec_module(captures)


def waves(rng, n, rate, columns, fastest=1.2):
    t = np.arange(n)[:, None] / rate
    out = []
    for mean, size in columns:
        f, ph = rng.uniform(0.1, fastest, 3), rng.uniform(0, 2 * np.pi, 3)
        out.append(mean + size * np.sin(2 * np.pi * f * t + ph).sum(1) / 3)
    return np.stack(out, 1)


def frames(rate, p, R, points=None, ground=0.0, smooth=False):
    """The 25 channels of positions [N, 3], rotations and further points [N, K, 3], +Y up, m."""
    t = np.arange(len(p)) / rate
    q = captures.qcont(np.roll(R.as_quat(), 1, axis=1))
    J = None if points is None else np.concatenate([p[:, None], points], 1)
    cut = 8.0 if rate > FPS * 1.05 else min(8.0, 0.4 * rate)
    if not smooth:
        p = captures.lowpass(p, rate, cut)
        q = captures.qnorm(captures.lowpass(q, rate, cut))
        J = None if J is None else captures.lowpass(J.reshape(len(J), -1), rate, cut).reshape(J.shape)
    tt = np.arange(int(np.floor(t[-1] * FPS + 1e-6)) + 1) / FPS
    P = captures.resample(t, p, tt)
    Q = captures.qcont(captures.qnorm(captures.resample(t, q, tt)))
    if J is not None:
        ground = np.percentile(J[..., 1], 1)
    off = np.array([P[0, 0], ground, P[0, 2]])
    P = P - off
    V = np.diff(P, axis=0) * FPS
    A = np.diff(V, axis=0) * FPS
    W = captures.angvel(Q)
    T = len(A)
    JJ = None
    if J is not None:
        JJ = captures.resample(t, (J - off).reshape(len(J), -1), tt[:T]).reshape(T, -1, 3)
    P, V, Q, W = P[:T], V[:T], Q[:T], W[:T]
    S = captures.style8(P, V, A, Q, JJ)
    return np.hstack([P, V, A, Q, W, np.zeros((T, 1)), S])


def save(name, expected):
    print(f"{name}: {expected.shape[0]} frames, path {np.linalg.norm(np.diff(expected[:, :3], axis=0), axis=1).sum():.2f} m")
    np.save(HERE / f"{name}.expected.npy", expected)


# SMPL: the whole body turns about its pelvis, which then moves by the translation.


def body(rng, n, rate):
    """A body that faces +Z, turns by several radians and leans: rotation vectors [N, 3]."""
    yaw = np.linspace(0, 5.0, n) + waves(rng, n, rate, [(0, 0.5)], 0.6)[:, 0]
    lean = waves(rng, n, rate, [(0.1, 0.25), (0, 0.2)])
    return Rotation.from_euler("YXZ", np.column_stack([yaw, lean]))


def smpl_expected(rate, rotvec, translation, up_z):
    p = translation + MEAN_PELVIS
    R = Rotation.from_rotvec(rotvec)
    if up_z:
        # z becomes y, and -y becomes z.
        turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])
        p = p @ turn.T
        R = Rotation.from_matrix(turn) * R
    return frames(rate, p, R)


def write_smpl(rng):
    n, rate, s = 271, 60.0, 93.7
    poses = np.concatenate([body(rng, n, rate).as_rotvec(), np.round(rng.normal(0, 0.3, (n, 69)), 1)], 1)
    trans = s * waves(rng, n, rate, [(3, 0.7), (1.2, 0.1), (-2, 0.9)])
    np.savez_compressed(HERE / "aist.npz", smpl_poses=poses, smpl_trans=trans, smpl_scaling=np.array([s]), smpl_loss=0.1)
    save("aist", smpl_expected(rate, poses[:, :3], trans / s, False))

    up = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    for name, n, rate, dim, key in [("amass", 373, 120.0, 156, "mocap_framerate"), ("smplx", 151, 50.0, 165, "mocap_frame_rate")]:
        root = (up * body(rng, n, rate)).as_rotvec()
        poses = np.concatenate([root, np.round(rng.normal(0, 0.3, (n, dim - 3)), 1)], 1).astype(np.float32)
        trans = waves(rng, n, rate, [(-1, 0.8), (4, 0.6), (0.93, 0.08)])
        more = {key: np.array(rate), "gender": np.array("female"), "betas": np.zeros(16)}
        if name == "amass":
            more["labels"] = np.array([{"any": "object"}], dtype=object)
        np.savez_compressed(HERE / f"{name}.npz", poses=poses, trans=trans, **more)
        save(name, smpl_expected(rate, poses[:, :3].astype(float), trans, True))

    n, rate = 131, 24.0
    poses = np.concatenate([body(rng, n, rate).as_rotvec(), np.zeros((n, 69))], 1).reshape(n, 24, 3)
    trans = waves(rng, n, rate, [(0, 0.8), (1.1, 0.1), (0, 0.6)])
    np.savez_compressed(HERE / "smpl.npz", poses=poses, trans=trans, fps=np.array([24]))
    save("smpl", smpl_expected(rate, poses[:, 0], trans, False))


# HumanML3D: features by their definition, from the positions of joints in the room.

PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]
OFFSETS = {1: (0.06, -0.09, 0), 2: (-0.06, -0.09, 0), 3: (0, 0.12, -0.02), 4: (0.04, -0.38, 0), 5: (-0.04, -0.38, 0)}
OFFSETS |= {6: (0, 0.14, 0), 7: (0, -0.4, -0.03), 8: (0, -0.4, -0.03), 9: (0, 0.06, 0.02), 10: (0.02, -0.06, 0.12), 11: (-0.02, -0.06, 0.12)}
OFFSETS |= {12: (0, 0.21, -0.03), 13: (0.07, 0.12, -0.02), 14: (-0.07, 0.12, -0.02), 15: (0, 0.09, 0.05), 16: (0.11, 0.04, 0), 17: (-0.11, 0.04, 0)}
OFFSETS |= {18: (0.26, -0.02, 0), 19: (-0.26, -0.02, 0), 20: (0.25, 0, 0), 21: (-0.25, 0, 0)}


def write_humanml3d(rng):
    n, rate = 62, 20.0
    heading = waves(rng, n, rate, [(0, 1.5)], 0.5)[:, 0]
    heading -= heading[0]
    facing = Rotation.from_euler("Y", heading[:, None])
    root = waves(rng, n, rate, [(0, 0.9), (0.92, 0.05), (0, 0.7)])
    root[:, [0, 2]] -= root[0, [0, 2]]
    # Joints swing about their parents; the trunk tilts, which the features do not tell of the root.
    joints, turns = np.zeros((n, 22, 3)), [None] * 22
    joints[:, 0], turns[0] = root, facing
    for j in range(1, 22):
        swing = Rotation.from_rotvec(waves(rng, n, rate, [(0, 0.4)] * 3))
        above = turns[PARENTS[j]]
        joints[:, j] = joints[:, PARENTS[j]] + above.apply(OFFSETS[j])
        turns[j] = above * swing
    inverse = facing.inv()
    turn = (inverse[1:] * facing[:-1]).as_rotvec()[:, 1] / 2
    velocity = inverse[1:].apply(np.diff(root, axis=0))
    flat = root * [1, 0, 1]
    local = np.stack([inverse.apply(joints[:, j] - flat) for j in range(1, 22)], 1)
    rest = np.round(rng.normal(0, 1, (n - 1, 21 * 6 + 22 * 3 + 4)), 1)
    features = np.column_stack([turn, velocity[:, [0, 2]], root[:-1, 1], local[:-1].reshape(n - 1, -1), rest])
    assert features.shape == (61, 263)
    np.save(HERE / "humanml3d.npy", features.astype(np.float32))
    save("humanml3d", frames(rate, root[:-1], facing[:-1], joints[:-1, 1:]))


# BVH. Rotations by SciPy, in intrinsic order.


class Node:
    def __init__(self, name, offset, children=(), end=None):
        self.name, self.offset, self.children, self.end = name, offset, children, end


def write_bvh(path, root, order, positions, angles, static=None):
    """positions, angles: by node name; nodes without positions have three channels."""
    lines, names, kinematics = ["HIERARCHY"], [], {}
    rotations = " ".join(f"{axis}rotation" for axis in order)

    def walk(node, depth, parent):
        pad = "\t" * depth
        n = 3 if node.name not in positions else 6
        channels = f"CHANNELS {n} " + ("Xposition Yposition Zposition " if n == 6 else "") + rotations
        lines.extend([f"{pad}{'JOINT' if depth else 'ROOT'} {node.name}", f"{pad}{{"])
        lines.extend([f"{pad}\tOFFSET {' '.join(f'{x:.6f}' for x in node.offset)}", f"{pad}\t{channels}"])
        names.append(node.name)
        local = positions.get(node.name, np.tile(node.offset, (len(angles[node.name]), 1)).astype(float))
        R = Rotation.from_euler(order, angles[node.name], degrees=True)
        if parent is None:
            kinematics[node.name] = (local, R)
        else:
            above, turn = kinematics[parent]
            kinematics[node.name] = (above + turn.apply(local), turn * R)
        for child in node.children:
            walk(child, depth + 1, node.name)
        if node.end is not None:
            lines.extend([f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET {' '.join(f'{x:.6f}' for x in node.end)}", f"{pad}\t}}"])
            p, R = kinematics[node.name]
            kinematics[f"{node.name}_end"] = (p + R.apply(np.tile(node.end, (len(p), 1))), R)
        lines.append(f"{pad}}}")

    walk(root, 0, None)
    columns = [x for name in names for x in ([positions[name]] if name in positions else []) + [angles[name]]]
    rows = np.hstack(columns)
    lines += ["MOTION", f"Frames: {len(rows)}", "Frame Time: 0.033333"]
    lines += [" ".join(f"{x:.6f}" for x in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return kinematics


def lafan1_side(side, z):
    leg = Node(f"{side}UpLeg", (0.103456, 1.857840, 10.548509 * z), [Node(f"{side}Leg", (43.5, 0, 0), [Node(f"{side}Foot", (42.372192, 0, 0), [Node(f"{side}Toe", (17.3, 0, 0), (), (0, 0, 0))])])])
    arm = Node(f"{side}Shoulder", (11.692, -0.36, 4.3 * z), [Node(f"{side}Arm", (11.4, 0, 0), [Node(f"{side}ForeArm", (32.8, 0, 0), [Node(f"{side}Hand", (27.6, 0, 0), (), (0, 0, 0))])])])
    return leg, arm


def write_lafan1(rng):
    n = 127
    (left_leg, left_arm), (right_leg, right_arm) = lafan1_side("Left", 1), lafan1_side("Right", -1)
    neck = Node("Neck", (25.7, 0, 0), [Node("Head", (11.8, 0, 0), (), (0, 0, 0))])
    spine = Node("Spine", (6.901967, -2.603725, 0), [Node("Spine1", (12.5881, 0, 0), [Node("Spine2", (12.3437, 0, 0), [neck, left_arm, right_arm])])])
    root = Node("Hips", (-224.689499, 91.882057, -431.625488), [left_leg, right_leg, spine])
    # Bones lie along +X, the left is +Z, forward is +Y: the body's up, left and forward in the joint's axes.
    axes = Rotation.from_matrix(np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]]))
    carried = body(rng, n, 30.0)
    angles = {"Hips": (carried * axes.inv()).as_euler("ZYX", degrees=True)}

    def swing(sizes, mean=(0, 0, 0)):
        return waves(rng, n, 30.0, list(zip(mean, sizes)))

    # Legs hang: turned by half a turn about the left.
    for side in ("Left", "Right"):
        angles[f"{side}UpLeg"] = swing((25, 5, 5), (180, 0, 0))
        angles[f"{side}Leg"] = swing((20, 2, 2), (-20, 0, 0))
        angles[f"{side}Foot"] = swing((10, 3, 3), (-90, 0, 0))
        angles[f"{side}Toe"] = swing((5, 1, 1))
        angles[f"{side}Shoulder"] = swing((5, 5, 5), (0, -80 if side == "Left" else 80, 0))
        angles[f"{side}Arm"] = swing((30, 30, 30), (0, -60 if side == "Left" else 60, 0))
        angles[f"{side}ForeArm"] = swing((30, 10, 10))
        angles[f"{side}Hand"] = swing((10, 10, 10))
    for name in ("Spine", "Spine1", "Spine2", "Neck", "Head"):
        angles[name] = swing((6, 6, 6))
    position = waves(rng, n, 30.0, [(-220, 60), (90, 4), (-430, 70)])
    nodes = write_bvh(HERE / "lafan1.bvh", root, "ZYX", {"Hips": position}, angles)
    p, R = nodes.pop("Hips")
    save("lafan1", frames(30.0, p / 100, R * axes, np.stack([p for p, _ in nodes.values()], 1) / 100))


def bandai_side(side, x):
    leg = Node(f"UpperLeg_{side}", (9.2 * x, -4.6, 0.6), [Node(f"LowerLeg_{side}", (0, -41.3, 0.5), [Node(f"Foot_{side}", (0, -39.1, -2.6), [Node(f"Toes_{side}", (0, -6.2, 12.4), (), (0, 0, 5.0))])])])
    arm = Node(f"Shoulder_{side}", (3.1 * x, 19.5, -1.0), [Node(f"UpperArm_{side}", (12.3 * x, 0, 0), [Node(f"LowerArm_{side}", (26.1 * x, 0, 0), [Node(f"Hand_{side}", (24.4 * x, 0, 0), (), (8.0 * x, 0, 0))])])])
    return leg, arm


def write_bandai(rng):
    n = 113
    (left_leg, left_arm), (right_leg, right_arm) = bandai_side("L", 1), bandai_side("R", -1)
    chest = Node("Chest", (0, 12.9, 1.4), [Node("Neck", (0, 25.3, -1.9), [Node("Head", (0, 8.1, 1.2), (), (0, 18.0, 0))]), left_arm, right_arm])
    hips = Node("Hips", (-11.2566, 91.3362, 32.6117), [Node("Spine", (0, 9.4, -0.8), [chest]), left_leg, right_leg])
    root = Node("joint_Root", (0, 0, 0), [hips])
    positions, angles = {}, {}

    def walk(node):
        positions[node.name] = np.tile(node.offset, (n, 1)).astype(float)
        angles[node.name] = waves(rng, n, 30.0, [(0, 12)] * 3)
        for child in node.children:
            walk(child)

    walk(root)
    angles["joint_Root"] = np.zeros((n, 3))
    angles["Hips"] = body(rng, n, 30.0).as_euler("ZXY", degrees=True)
    positions["Hips"] = waves(rng, n, 30.0, [(-11, 60), (91, 4), (32, 50)])
    nodes = write_bvh(HERE / "bandai.bvh", root, "ZXY", positions, angles)
    p, R = nodes.pop("Hips")
    del nodes["joint_Root"]
    save("bandai", frames(30.0, p / 100, R, np.stack([p for p, _ in nodes.values()], 1) / 100))


# MikuMikuDance: a left-handed world of 8 cm units, keys with curves.

UNIT = 0.08
MIRROR = np.diag([1, 1, -1.0])


def curve(controls, time):
    x1, y1, x2, y2 = np.minimum(np.array(controls) / 127, 1)
    at = lambda a, b, s: 3 * (1 - s) ** 2 * s * a + 3 * (1 - s) * s**2 * b + s**3
    return at(y1, y2, brentq(lambda s: at(x1, x2, s) - time, 0, 1, xtol=1e-13)) if 0 < time < 1 else time


def vmd(path, bones=(), cameras=()):
    out = b"Vocaloid Motion Data 0002".ljust(30, b"\0") + "ミク".encode("shift_jis").ljust(20, b"\0")
    out += struct.pack("<I", len(bones)) + b"".join(bones) + struct.pack("<I", 2) + b"smile".ljust(23, b"\0") * 2
    out += struct.pack("<I", len(cameras)) + b"".join(cameras) + struct.pack("<III", 0, 0, 0)
    path.write_bytes(out)


def bone_key(name, frame, position, rotation, curves):
    """curves: [4][x1, y1, x2, y2] of x, y, z and the rotation."""
    first = bytes(curves[axis][i] for i in range(4) for axis in range(4))
    rows = [first[k:] + bytes([1] + [0] * (k - 1)) * (k > 0) for k in range(4)]
    interpolation = bytearray(b"".join(rows))
    # Models with physics have a flag here, over the curves of the first row.
    interpolation[2:4] = b"\x63\x0f"
    return struct.pack("<15sI3f4f", name.encode("shift_jis"), frame, *position, *rotation.as_quat()) + bytes(interpolation)


def between(keys, n):
    """Positions [N, 3] and rotations of the keys (frame, position, rotation, curves)."""
    keys = sorted(keys, key=lambda key: key[0])
    P, R = [], []
    for t in range(n):
        before = [key for key in keys if key[0] <= t] or keys[:1]
        after = [key for key in keys if key[0] > t]
        a = before[-1]
        if a[0] >= t or not after:
            P.append(a[1])
            R.append(a[2])
            continue
        b = after[0]
        x, y, z, r = (curve(c, (t - a[0]) / (b[0] - a[0])) for c in b[3])
        P.append(a[1] + np.array([x, y, z]) * (b[1] - a[1]))
        R.append(Slerp([0, 1], Rotation.concatenate([a[2], b[2]]))(r))
    return np.array(P), Rotation.concatenate(R)


def single(x):
    return np.asarray(x, np.float32).astype(float)


def write_vmd(rng):
    last = 97
    tracks, written = {}, []
    for name, at, travel, turn in [
        ("全ての親", [0, 40, last], 6.0, 0.8),
        ("センター", [0, 17, 31, 58, 80], 4.0, 0.3),
        ("グルーブ", [5, 24, 66], 0.8, 0.1),
        ("右腕", [0, 50], 0.0, 1.0),
    ]:
        keys = []
        for frame in at:
            position = single(rng.uniform(-1, 1, 3) * [travel, travel / 4, travel])
            rotation = Rotation.from_quat(single(Rotation.from_rotvec(rng.normal(0, turn, 3)).as_quat()))
            curves = [rng.integers(0, 128, 4).tolist() for _ in range(4)] if frame % 2 else [[20, 20, 107, 107]] * 4
            keys.append((frame, position, rotation, curves))
        tracks[name] = keys
        written += [bone_key(name, *key) for key in keys]
    # Files are in no order of time.
    vmd(HERE / "dance.vmd", [written[i] for i in rng.permutation(len(written))])
    n = last + 1
    M = np.tile(np.eye(4), (n, 1, 1))
    for name, rest in [("全ての親", [0, 0, 0]), ("センター", [0, 8, 0]), ("グルーブ", [0, 0, 0])]:
        P, R = between(tracks[name], n)
        local = np.tile(np.eye(4), (n, 1, 1))
        local[:, :3, :3], local[:, :3, 3] = R.as_matrix(), P + rest
        M = M @ local
    save("dance", frames(30.0, M[:, :3, 3] @ MIRROR * UNIT, Rotation.from_matrix(MIRROR @ M[:, :3, :3] @ MIRROR), smooth=True))

    # The camera: at a distance from its target, turned about it, and looking at it.
    keys = []
    for frame in [0, 33, 70, 96]:
        numbers = single(np.r_[-rng.uniform(26, 34), rng.uniform(-2, 2), 12 + rng.uniform(-1, 1), rng.uniform(-2, 2), rng.normal(0, [0.1, 0.25, 0.05])])
        curves = [rng.integers(0, 128, 4).tolist() for _ in range(6)]
        keys.append((frame, numbers, curves))
    packed = [struct.pack("<I7f", frame, *numbers) + bytes(c[i] for c in curves for i in (0, 2, 1, 3)) + struct.pack("<IB", 30, 0) for frame, numbers, curves in keys]
    vmd(HERE / "camera.vmd", cameras=packed[::-1])
    rows = []
    for t in range(97):
        a = [key for key in keys if key[0] <= t][-1]
        after = [key for key in keys if key[0] > t]
        if a[0] == t or not after:
            rows.append(a[1])
            continue
        b = after[0]
        x, y, z, r, d, _ = (curve(c, (t - a[0]) / (b[0] - a[0])) for c in b[2])
        rows.append(a[1] + np.array([d, x, y, z, r, r, r]) * (b[1] - a[1]))
    d, target, (alpha, beta, gamma) = np.array(rows)[:, 0], np.array(rows)[:, 1:4], np.array(rows)[:, 4:].T
    turn = Rotation.from_euler("YZX", np.column_stack([beta, -gamma, alpha]))
    eye = target @ MIRROR + turn.apply(np.column_stack([0 * d, 0 * d, -d]))
    # Sight goes from the eye to the target, along the body's +Z.
    sight = (target @ MIRROR - eye) / np.linalg.norm(target @ MIRROR - eye, axis=1, keepdims=True)
    up = turn.apply([0, 1, 0])
    R = Rotation.from_matrix(np.stack([np.cross(up, sight), up, sight], 2))
    save("camera", frames(30.0, eye * UNIT, R, smooth=True))


def main():
    print(f"numpy {np.__version__}, scipy {scipy.__version__}, seed {SEED}")
    rng = np.random.default_rng(SEED)
    write_smpl(rng)
    write_humanml3d(rng)
    write_lafan1(rng)
    write_bandai(rng)
    write_vmd(rng)


if __name__ == "__main__":
    main()
