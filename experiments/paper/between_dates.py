"""`python -m experiments.paper.between_dates`: learns edges that stay between dates.

A small network sees one date of a generated landscape and predicts where Canny finds edges at
another date. What crops, seasons and light draw is not there at the other date, so it is not
predicted; what stays is. The network takes grey levels and needs no second date in flight. No
landscape of the experiments is used, and no real imagery. The file is what `--edges
onnx:weights=experiments/paper/between_dates.onnx` takes.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import permutations
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from experiments.paper.methods import BETWEEN_DATES
from orthonav.extras import needed
from orthonav.files import replacing
from orthonav.represent.canny import Canny
from orthonav.simulate.landscape import DEFAULT_DATES, generate_area

AREAS = ((101, 1.0), (102, 1.0), (103, 1.5), (104, 2.0), (105, 3.0), (106, 5.0))
"""Seed and ground resolution of the landscapes; those of the experiments have other seeds."""
HELD_OUT = (107, 1.5)
AREA_PX = 640
WIDTH, DILATIONS = 24, (1, 2, 4, 1)
CROP_PX, BATCH, STEPS, RATE = 96, 12, 300, 3e-3
GAIN, OFFSET = (0.5, 1.5), 0.2
"""Factor of the grey levels around their mean, and the largest brightness added, 0 to 1."""
RIDGE_PX = 4
"""An edge is where a logit is above the mean of a square with so many pixels on each side: else
woods and orchards would be all edge, and roads none."""
COUNTED_PX = 256
"""Edges are counted in the lower left corner of each landscape, of this size."""
REACH_PX = 1
"""An edge counts as predicted this far from where Canny has it."""
OPSET, IR_VERSION = 17, 8
Dates = list[NDArray[np.uint8]]


def network() -> nn.Sequential:
    """Convolutions without padding: grey levels (N, 1, H + 2 m, W + 2 m) to logits (N, 1, H, W)."""
    layers: list[nn.Module] = [nn.Conv2d(1, WIDTH, 5), nn.ReLU(inplace=True)]
    for dilation in DILATIONS:
        layers += [nn.Conv2d(WIDTH, WIDTH, 3, dilation=dilation), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, nn.Conv2d(WIDTH, 1, 1))


def margin_px(model: nn.Sequential) -> int:
    """Pixels on each side that the network needs."""
    kernels = (each for each in model if isinstance(each, nn.Conv2d))
    return sum(each.dilation[0] * (each.kernel_size[0] - 1) // 2 for each in kernels)


def landscape(seed: int, gsd_m: float, folder: Path) -> Dates:
    """Grey levels (H, W) of each date."""
    side_m = AREA_PX * gsd_m
    paths = generate_area(folder, size_m=(side_m, side_m), gsd_m=gsd_m, seed=seed)
    return [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8) for path in paths]


def canny(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Canny edges (H, W), 0 or 1, with the paper's thresholds."""
    return np.asarray(Canny()(grey, np.ones(grey.shape, np.bool_))[0], np.uint8)


def widened(edges: NDArray[np.uint8], reach_px: int = REACH_PX) -> NDArray[np.uint8]:
    """Edges (H, W) and what lies this near to them."""
    side = 2 * reach_px + 1
    return np.asarray(cv2.dilate(edges, np.ones((side, side), np.uint8)), np.uint8)


def batches(
    areas: Sequence[Dates], margin: int, steps: int
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Crops of one date with another light, and where there are edges at another date."""
    targets = [[widened(canny(grey)) for grey in dates] for dates in areas]
    pairs = list(permutations(range(len(areas[0])), 2))
    rng = np.random.default_rng(0)
    side = CROP_PX + 2 * margin
    for _ in range(steps):
        seen = np.empty((BATCH, 1, side, side), np.float32)
        wanted = np.empty((BATCH, 1, CROP_PX, CROP_PX), np.float32)
        for row in range(BATCH):
            area = int(rng.integers(len(areas)))
            one, other = pairs[int(rng.integers(len(pairs)))]
            grey, edges = areas[area][one], targets[area][other]
            y, x = (int(rng.integers(size - side + 1)) for size in grey.shape)
            part = grey[y : y + side, x : x + side].astype(np.float32) / 255
            level = part.mean()
            light = level + (part - level) * rng.uniform(*GAIN) + rng.uniform(-OFFSET, OFFSET)
            inner = edges[y + margin : y + side - margin, x + margin : x + side - margin]
            turns, mirrored = int(rng.integers(4)), int(rng.choice([-1, 1]))
            seen[row, 0] = np.rot90(np.clip(light, 0, 1), turns)[:, ::mirrored]
            wanted[row, 0] = np.rot90(inner, turns)[:, ::mirrored]
        yield torch.from_numpy(seen), torch.from_numpy(wanted)


def learn(areas: Sequence[Dates], steps: int = STEPS) -> nn.Sequential:
    """The network, with as many edges as Canny finds in the landscapes."""
    torch.manual_seed(0)
    model = network()
    margin = margin_px(model)
    optimizer = torch.optim.Adam(model.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    start, losses = time.monotonic(), []
    for step, (seen, wanted) in enumerate(batches(areas, margin, steps), start=1):
        loss = functional.binary_cross_entropy_with_logits(model(seen), wanted)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if step % 50 == 0 or step == steps:
            took_s = time.monotonic() - start
            print(f"step {step} of {steps}, loss {np.mean(losses[-50:]):.4f}, {took_s:.0f} s")
    parts = [grey[-COUNTED_PX:, :COUNTED_PX] for dates in areas for grey in dates]
    return cut_off(model, parts)


def cut_off(model: nn.Sequential, pictures: Dates) -> nn.Sequential:
    """The network with ridges as its last layer, and as many edges as Canny finds in pictures."""
    side = 2 * RIDGE_PX + 1
    last = nn.Conv2d(1, 1, side)
    with torch.no_grad():
        last.weight.fill_(-1 / side**2)
        last.weight[0, 0, RIDGE_PX, RIDGE_PX] += 1
        last.bias.zero_()  # type: ignore[union-attr]
    whole = nn.Sequential(*model, last).eval()
    share = float(np.mean([canny(grey).mean() for grey in pictures]))
    found = np.concatenate([logits(whole, grey).ravel() for grey in pictures])
    with torch.no_grad():
        last.bias.fill_(-float(np.quantile(found, 1 - share)))  # type: ignore[union-attr]
    return whole


def logits(model: nn.Sequential, grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Logits (H, W) of a picture (H, W); an edge is above zero."""
    margin = margin_px(model)
    padded = np.pad(grey.astype(np.float32) / 255, margin, mode="edge")
    with torch.no_grad():
        return np.asarray(model(torch.from_numpy(padded)[None, None])[0, 0].numpy())


def agreement(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Correlation coefficient of the edges (H, W) of two dates, a pixel apart at most.

    That of unrelated edges is 0, however many there are.
    """
    maps = [cv2.GaussianBlur(each.astype(np.float32), (0, 0), REACH_PX) for each in (one, other)]
    return float(np.corrcoef(maps[0].ravel(), maps[1].ravel())[0, 1])


def write(model: nn.Sequential, path: Path) -> None:
    """Write the network as ONNX, layer by layer; the same weights give the same bytes."""
    onnx = needed("onnx", "train", "writing a network")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    nodes, weights, value = [], [], "grey"
    for number, layer in enumerate(model):
        inputs, attributes = [value], {}
        if isinstance(layer, nn.Conv2d):
            for name, tensor in (("w", layer.weight), ("b", layer.bias)):
                assert tensor is not None
                array = tensor.detach().numpy()
                weights.append(onnx.numpy_helper.from_array(array, f"{name}{number}"))
                inputs.append(f"{name}{number}")
            attributes["dilations"] = list(layer.dilation)
        value = "edges" if number == len(model) - 1 else f"v{number}"
        operator = "Conv" if isinstance(layer, nn.Conv2d) else "Relu"
        nodes.append(helper.make_node(operator, inputs, [value], **attributes))
    ends = [
        [helper.make_tensor_value_info(name, kind, [1, 1, None, None])]
        for name in ("grey", "edges")
    ]
    graph = helper.make_graph(nodes, "edges between dates", *ends, weights)
    made = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="orthonav"
    )
    made.ir_version = IR_VERSION
    onnx.checker.check_model(made)
    with replacing(path) as temporary:
        temporary.write_bytes(made.SerializeToString())


def main() -> None:
    """Generate the landscapes, learn, write, and say how the edges of two dates agree."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.paper.between_dates", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--out", type=Path, default=BETWEEN_DATES, metavar="FILE.onnx")
    parser.add_argument("--steps", type=int, default=STEPS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="orthonav-dates-") as folder:
        made = [landscape(*each, Path(folder) / str(each[0])) for each in (*AREAS, HELD_OUT)]
    model = learn(made[:-1], options.steps)
    write(model, options.out)
    held = made[-1]
    learnt = [(logits(model, grey) > 0).astype(np.uint8) for grey in held]
    plain = [canny(grey) for grey in held]
    print(f"{sum(each.numel() for each in model.parameters()):,} parameters: {options.out}")
    for one, other in ((0, 1), (0, 2), (1, 2)):
        dates = f"{DEFAULT_DATES[one].name} and {DEFAULT_DATES[other].name}"
        pair = (agreement(plain[one], plain[other]), agreement(learnt[one], learnt[other]))
        print(f"correlation of {dates}, not learnt from: Canny {pair[0]:.2f}, learnt {pair[1]:.2f}")


if __name__ == "__main__":
    main()
