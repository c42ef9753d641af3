r"""Pack the networks of MediaPipe that facerf uses into one asset, from the .tflite files of its wheel.

    pip install tflite flatbuffers
    pip download mediapipe==0.10.21 --no-deps --only-binary=:all: --python-version 312 \
        --platform manylinux_2_28_x86_64
    python -m tools.mediapipe_weights mediapipe-0.10.21-*.whl FILE

The weights become half floats in torch's layout, sparse ones dense; paddings and axes are resolved for the
networks' fixed sizes of input; steps that no output in use needs are left out (`network/stored_graph.py`).
"""

import hashlib
import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import tflite
import torch
from flatbuffers import flexbuffers
from safetensors.torch import save_file

# By the names in the asset: the file, and the outputs in use by tflite's names and ours.
NETWORKS: dict[str, tuple[str, dict[str, str]]] = {
    "near_faces": ("face_detection_short_range", {"regressors": "boxes", "classificators": "scores"}),
    "far_faces": ("face_detection_full_range_sparse", {"Identity": "boxes", "Identity_1": "scores"}),
    "face_mesh": (
        "face_landmark_with_attention",
        {
            "output_mesh_identity": "mesh",
            "output_lips": "lips",
            "output_left_eye": "left_eye",
            "output_right_eye": "right_eye",
            "output_left_iris": "left_iris",
            "output_right_iris": "right_iris",
            "conv_faceflag": "score",
        },
    ),
    "person": ("selfie_segmentation", {"activation_10": "share"}),
    "body": ("pose_landmark_full", {"Identity": "points", "Identity_1": "score", "Identity_2": "mask"}),
}
_OPERATORS = {v: k for k, v in vars(tflite.BuiltinOperator).items() if isinstance(v, int)}
_ACTIVATIONS = {tflite.ActivationFunctionType.RELU: "relu", tflite.ActivationFunctionType.RELU6: "relu6"}
_TYPES = {
    tflite.TensorType.FLOAT32: np.float32,
    tflite.TensorType.FLOAT16: np.float16,
    tflite.TensorType.INT32: np.int32,
}
_AXES = {1: 2, 2: 3, 3: 1, -1: 1}  # of rows, columns, channels in tflite's order, in torch's
_SIMPLE = {
    "ADD": ("add", tflite.AddOptions),
    "MUL": ("multiply", tflite.MulOptions),
    "PRELU": ("prelu", None),
    "RELU": ("relu", None),
    "LOGISTIC": ("sigmoid", None),
    "HARD_SWISH": ("hard_swish", None),
    "TransformLandmarks": ("uncrop", None),
}


class Converter:
    """Steps and weights of one network, as `StoredGraph` takes them."""

    def __init__(self, name: str, data: bytes) -> None:
        self.name = name
        self.steps: list[list[Any]] = []
        self.weights: dict[str, torch.Tensor] = {}
        model = tflite.Model.GetRootAs(data, 0)
        graph = model.Subgraphs(0)
        self.tensors = [graph.Tensors(number) for number in range(graph.TensorsLength())]
        self.names = [tensor.Name().decode() for tensor in self.tensors]
        self.constants = {
            number: stored_values(model.Buffers(tensor.Buffer()), tensor)
            for number, tensor in enumerate(self.tensors)
            if model.Buffers(tensor.Buffer()).DataLength()
        }
        (image,) = graph.InputsAsNumpy()
        self.values: dict[int, int] = {int(image): 0}  # numbers of ours by tflite's
        for number in range(graph.OperatorsLength()):
            operator = graph.Operators(number)
            code = model.OperatorCodes(operator.OpcodeIndex())
            kind = (code.CustomCode() or b"").decode()
            self.add(kind or _OPERATORS[max(code.BuiltinCode(), code.DeprecatedBuiltinCode())], operator)

    def shape(self, number: int) -> list[int]:
        """The shape of a value, in tflite's order."""
        return [int(side) for side in self.tensors[number].ShapeAsNumpy()]

    def graph(self, outputs: dict[str, str]) -> dict[str, Any]:
        """The steps that some outputs need, as JSON, and which values are last used by which step."""
        wanted = {ours: self.values[self.names.index(theirs)] for theirs, ours in outputs.items()}
        needed = set(wanted.values())
        steps: list[list[Any]] = []
        for step in reversed(self.steps):
            if step[2] in needed:
                needed.update(key for key in step[1] if isinstance(key, int))
                steps.insert(0, step)
        last_use: dict[int, int] = {key: step[2] for step in steps for key in step[1] if isinstance(key, int)}
        ends: dict[int, list[int]] = {}
        for key, step_output in last_use.items():
            if key not in wanted.values():
                ends.setdefault(step_output, []).append(key)
        return {"steps": steps, "outputs": wanted, "last_use": ends}

    def add(self, kind: str, operator: Any) -> None:
        """Translate an operator; weights are unpacked at once."""
        inputs = [int(number) for number in operator.InputsAsNumpy()]
        (output,) = (int(number) for number in operator.OutputsAsNumpy())
        if kind in ("DEQUANTIZE", "DENSIFY"):
            self.constants[output] = self.constants[inputs[0]].astype(np.float32)
            return
        constant = [self.constants.get(number) for number in inputs]
        method = getattr(self, f"_{kind.lower()}", None)
        if method is not None:
            name, taken, settings = method(operator, inputs, output, constant)
        else:
            name, taken, settings = _SIMPLE[kind][0], [self.operand(n, output) for n in inputs], {}
        self.step(name, taken, output, settings)
        options = {"CONV_2D": tflite.Conv2DOptions, "DEPTHWISE_CONV_2D": tflite.DepthwiseConv2DOptions}
        options |= {key: pair[1] for key, pair in _SIMPLE.items() if pair[1]}
        if kind in options:
            code = table(operator, options[kind]).FusedActivationFunction()
            if code != tflite.ActivationFunctionType.NONE:
                self.step(_ACTIVATIONS[code], [self.values[output]], output, {})

    def step(self, name: str, inputs: list[int | str], output: int, settings: dict[str, Any]) -> None:
        """Add a step that makes a value."""
        number = len(self.steps) + 1
        self.steps.append([name, inputs, number, settings])
        self.values[output] = number

    def weight(self, number: int, values: np.ndarray) -> str:
        """Keep a weight; return its name."""
        name = f"{self.name}.{number}"
        self.weights[name] = torch.from_numpy(np.array(values, np.float32, order="C"))
        return name

    def operand(self, number: int, output: int) -> int | str:
        """A value, or a constant that broadcasts against torch's layout."""
        if number in self.values:
            return self.values[number]
        values = np.asarray(self.constants[number], np.float32)
        if len(self.shape(output)) == 4 and values.ndim:
            values = values.reshape([1] * (4 - values.ndim) + list(values.shape)).transpose(0, 3, 1, 2)
        if values.shape[-2:] == (4, 4):  # matrices of crops: x and y of a plane
            values = values[..., :2, [0, 1, 3]]
        return self.weight(number, values)

    def _convolution(
        self, options: Any, inputs: list[int], output: int, kernel: np.ndarray, groups: int
    ) -> Any:
        stride = [options.StrideH(), options.StrideW()]
        dilation = [options.DilationHFactor(), options.DilationWFactor()]
        pad = [0, 0, 0, 0]
        if options.Padding() == tflite.Padding.SAME:
            pad = same_padding(self.shape(inputs[0])[1:3], kernel.shape[2:], stride, dilation)
        taken = [self.values[inputs[0]], self.weight(inputs[1], kernel)]
        taken += [self.weight(number, self.constants[number]) for number in inputs[2:]]
        return "convolve", taken, {"stride": stride, "pad": pad, "dilation": dilation, "groups": groups}

    def _conv_2d(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        options = table(operator, tflite.Conv2DOptions)
        return self._convolution(options, inputs, output, constant[1].transpose(0, 3, 1, 2), 1)

    def _depthwise_conv_2d(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        options = table(operator, tflite.DepthwiseConv2DOptions)
        kernel = constant[1].transpose(3, 0, 1, 2)
        return self._convolution(options, inputs, output, kernel, self.shape(inputs[0])[3])

    def _convolution2dtransposebias(
        self, operator: Any, inputs: list[int], output: int, constant: Any
    ) -> Any:
        """MediaPipe's own; its options are a C struct: padding (1: SAME), strides of columns and rows."""
        padding, across, down = np.frombuffer(operator.CustomOptionsAsNumpy().tobytes()[:12], np.int32)
        kernel, stride = constant[1].transpose(3, 0, 1, 2), [int(down), int(across)]
        size = self.shape(output)[1:3]
        full = [
            (n - 1) * s + k
            for n, s, k in zip(self.shape(inputs[0])[1:3], stride, kernel.shape[2:], strict=True)
        ]
        crop = [(whole - side) // 2 if padding == 1 else 0 for whole, side in zip(full, size, strict=True)]
        taken = [self.values[inputs[0]], self.weight(inputs[1], kernel), self.weight(inputs[2], constant[2])]
        return "convolve_transposed", taken, {"stride": stride, "crop": crop, "size": size}

    def _max_pool_2d(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        options = table(operator, tflite.Pool2DOptions)
        kernel = [options.FilterHeight(), options.FilterWidth()]
        stride, pad = [options.StrideH(), options.StrideW()], [0, 0, 0, 0]
        if options.Padding() == tflite.Padding.SAME:
            pad = same_padding(self.shape(inputs[0])[1:3], kernel, stride, [1, 1])
        return "max_pool", [self.values[inputs[0]]], {"kernel": kernel, "stride": stride, "pad": pad}

    def _average_pool_2d(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        options = table(operator, tflite.Pool2DOptions)
        kernel = [options.FilterHeight(), options.FilterWidth()]
        assert kernel == self.shape(inputs[0])[1:3], "means are over the whole image"
        return "mean_pool", [self.values[inputs[0]]], {"kernel": kernel, "stride": kernel}

    def _resize_bilinear(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        options = table(operator, tflite.ResizeBilinearOptions)
        settings = {
            "size": self.shape(output)[1:3],
            "align_corners": bool(options.AlignCorners()),
            "half_pixel": bool(options.HalfPixelCenters()),
        }
        return "resize", [self.values[inputs[0]]], settings

    def _pad(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        rows, columns, channels = constant[1].tolist()[1:]
        return "pad", [self.values[inputs[0]]], {"pad": [*columns, *rows, *channels]}

    def _depth_to_space(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        block = table(operator, tflite.DepthToSpaceOptions).BlockSize()
        return "depth_to_space", [self.values[inputs[0]]], {"block": block}

    def _concatenation(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        axis = table(operator, tflite.ConcatenationOptions).Axis()
        axis = _AXES[axis] if len(self.shape(output)) == 4 else axis
        return "join", [self.values[number] for number in inputs], {"axis": axis}

    def _reshape(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        shape = self.shape(output)[1:]
        return "to_image" if len(shape) == 3 else "flatten", [self.values[inputs[0]]], {"shape": shape}

    def _strided_slice(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        assert self.shape(output) == self.shape(inputs[0]), "only a copy of the whole is known"
        return "first", [self.values[inputs[0]]], {"count": self.shape(output)[3], "axis": 1}

    def _landmarks2transformmatrix(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        options = flexbuffers.Loads(operator.CustomOptionsAsNumpy().tobytes())
        settings = {
            "scale": [options["scale_x"], options["scale_y"]],
            "size": [options["output_width"], options["output_height"]],
            "left": options["left_rotation_idx"],
            "right": options["right_rotation_idx"],
            "inside": options["subset_idxs"],
            "turn_rad": options["target_rotation_radians"],
        }
        return "turned_crop", [self.values[inputs[0]]], settings

    def _transformtensorbilinear(self, operator: Any, inputs: list[int], output: int, constant: Any) -> Any:
        return "crop", [self.values[number] for number in inputs], {"size": self.shape(output)[1:3]}


def table(operator: Any, kind: Any) -> Any:
    """An operator's options as tables of some kind, such as tflite.Conv2DOptions."""
    stored, options = operator.BuiltinOptions(), kind()
    options.Init(stored.Bytes, stored.Pos)
    return options


def same_padding(size: Any, kernel: Any, stride: Any, dilation: Any) -> list[int]:
    """Padding of left, right, top and bottom by tflite's rule SAME: the odd pixel comes after."""
    padding: list[int] = []
    for length, k, s, d in reversed(list(zip(size, kernel, stride, dilation, strict=True))):
        total = max((-(-length // s) - 1) * s + (k - 1) * d + 1 - length, 0)
        padding += [total // 2, total - total // 2]
    return padding


def stored_values(buffer: Any, tensor: Any) -> np.ndarray:
    """A constant as a dense array in tflite's layout."""
    values = buffer.DataAsNumpy().view(_TYPES[tensor.Type()])
    shape = [int(side) for side in tensor.ShapeAsNumpy()] if tensor.ShapeLength() else []
    if not tensor.Sparsity():
        return np.asarray(values.reshape(shape))
    return dense(values.astype(np.float32), tensor.Sparsity(), shape)


def dense(values: np.ndarray, sparsity: Any, shape: list[int]) -> np.ndarray:
    """A sparse constant as a dense array: its levels are expanded one after the other, then its blocks."""
    order, blocks = sparsity.TraversalOrderAsNumpy(), sparsity.BlockMapAsNumpy()
    rank = len(shape)
    block_side = [1] * rank
    for level, axis in enumerate(order):
        if axis >= rank:
            block_side[blocks[axis - rank]] = sparsity.DimMetadata(level).DenseSize()
    index, count = np.zeros((1, rank), np.int64), 1
    for level, axis in enumerate(order):
        metadata = sparsity.DimMetadata(level)
        if metadata.Format() == tflite.DimensionType.DENSE:
            own = np.tile(np.arange(metadata.DenseSize()), count)
            index = np.repeat(index, metadata.DenseSize(), 0)
        else:
            segments, own = (sparse_vector(metadata, kind) for kind in ("ArraySegments", "ArrayIndices"))
            index = np.repeat(index, np.diff(segments), 0)
        along, step = (axis, block_side[axis]) if axis < rank else (blocks[axis - rank], 1)
        index[:, along] += own.astype(np.int64) * step
        count = len(index)
    result = np.zeros(shape, np.float32)
    result[tuple(index.T)] = values[:count]
    return result


def sparse_vector(metadata: Any, kind: str) -> np.ndarray:
    """Segments or indices of a sparse level, whichever type they are stored in."""
    kinds = {1: tflite.Int32Vector, 2: tflite.Uint16Vector, 3: tflite.Uint8Vector}
    stored, vector = getattr(metadata, kind)(), kinds[getattr(metadata, f"{kind}Type")()]()
    vector.Init(stored.Bytes, stored.Pos)
    return np.asarray(vector.ValuesAsNumpy(), np.int64)


def main(wheel: str, target: str) -> None:
    """Convert the networks of a wheel; write the asset, and print the digest of each original for NOTICE."""
    weights: dict[str, torch.Tensor] = {}
    metadata: dict[str, str] = {}
    with zipfile.ZipFile(wheel) as archive:
        for name, (file, outputs) in NETWORKS.items():
            (path,) = (entry for entry in archive.namelist() if entry.endswith(f"/{file}.tflite"))
            data = archive.read(path)
            print(f"{Path(path).name}  {hashlib.sha256(data).hexdigest()}")
            converter = Converter(name, data)
            graph = converter.graph(outputs)
            used = {key for step in graph["steps"] for key in step[1] if isinstance(key, str)}
            weights |= {key: converter.weights[key].half() for key in sorted(used)}
            metadata[name] = json.dumps(graph, separators=(",", ":"))
    save_file(weights, target, metadata)


if __name__ == "__main__":
    main(*sys.argv[1:])
