"""Writes the .npy and .npz files beside this script, with NumPy (2.x).

    pip install numpy && python make.py

The value at flat C index i of every array is (i * 7 % 23) - 11, divided by 4 in float arrays, so
that it is exact in every type down to i1 and f2. Unsigned arrays hold i * 7 % 23, boolean arrays
whether that is odd. The Rust tests compute the same rule themselves.
"""

import pathlib
import zipfile

import numpy as np

HERE = pathlib.Path(__file__).parent
SHAPE = (3, 5, 2)


def values(shape, dtype):
    base = np.arange(int(np.prod(shape)), dtype=np.int64) * 7 % 23
    if dtype.kind == "b":
        base = base % 2 == 1
    elif dtype.kind == "i":
        base = base - 11
    elif dtype.kind == "f":
        base = (base - 11) / 4
    return base.astype(dtype).reshape(shape)


def save(name, array, version=None):
    with open(HERE / name, "wb") as file:
        np.lib.format.write_array(file, array, version=version, allow_pickle=True)


def main():
    for old in [*HERE.glob("*.npy"), *HERE.glob("*.npz")]:
        old.unlink()
    for code in ["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"]:
        for order, order_name in [("<", "le"), (">", "be")]:
            if code[1] == "1" and order == ">":
                continue  # one byte has no order; NumPy writes "|"
            array = values(SHAPE, np.dtype(order + code))
            save(f"{code}_{order_name}_c.npy", np.ascontiguousarray(array))
            save(f"{code}_{order_name}_fortran.npy", np.asfortranarray(array))
    float32 = np.dtype("<f4")
    save("version_2.npy", values(SHAPE, float32), (2, 0))
    save("version_3.npy", values(SHAPE, float32), (3, 0))
    save("scalar.npy", np.array(values((3,), float32)[2]))
    save("vector.npy", values((7,), float32))
    save("motion.npy", values((25, 9), float32))
    save("empty_axis.npy", np.zeros((0, 4), float32))

    save("refused_complex.npy", np.zeros(2, "<c8"))
    save("refused_datetime.npy", np.zeros(2, "<M8[ns]"))
    save("refused_bytes.npy", np.array([b"ab", b"c"]))
    save("refused_text.npy", np.array(["ab", "c"]))
    save("refused_structured.npy", np.zeros(2, [("a", "<f4"), ("b", "<i4", (3,))]))
    save("refused_longdouble.npy", np.zeros(2, np.longdouble))
    save("refused_pickle.npy", np.array([{"a": 1}, None], dtype=object))

    arrays = {
        "mel": values((8, 6), float32),
        "beats": values((5,), np.dtype("<i8")),
        "power": np.asfortranarray(values((4, 3), np.dtype("<f8"))),
        "sample_rate_hz": np.array(22050),
    }
    np.savez(HERE / "stored.npz", **arrays)
    np.savez_compressed(HERE / "deflated.npz", **arrays)
    np.savez(HERE / "no_members.npz")
    with zipfile.ZipFile(HERE / "bzip2.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.write(HERE / "motion.npy", "mel.npy")
    with zipfile.ZipFile(HERE / "zip64.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        # What numpy.savez does for members of 2 GiB and more.
        with archive.open("mel.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array(member, arrays["mel"])


if __name__ == "__main__":
    main()
