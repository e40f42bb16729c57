"""`python -m experiments.paper.between_dates`: learns edges that stay between dates.

A small network sees one date of a generated landscape and predicts the edges that Canny finds at
all dates. What crops, seasons and light draw is not there at another date, so it is not predicted;
what stays is. A second term of the loss asks for the same prediction from two dates of the same
ground. The network takes grey levels and needs no second date in flight. No landscape of the
experiments is used, and no real imagery. The file is what `--edges
onnx:weights=experiments/paper/between_dates.onnx` takes.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from lab.landscape import DEFAULT_DATES, generate_area
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from experiments.paper.methods import BETWEEN_DATES
from orthonav.core.extras import needed
from orthonav.core.files import replacing, write_text
from orthonav.core.tiles.represent import Canny
from orthonav.research.training import Means, mixed_precision

AREAS = ((101, 1.0), (102, 1.0), (103, 1.5), (104, 2.0), (105, 3.0), (106, 5.0))
"""Seed and ground resolution of the landscapes; those of the experiments have other seeds."""
HELD_OUT = ((107, 1.5), (108, 1.0), (109, 2.0))
AREA_PX = 640
WIDTH, DILATIONS = 24, (1, 2, 4, 1)
CROP_PX, PAIRS, STEPS, RATE = 96, 6, 900, 2e-3
GAIN, OFFSET = (0.5, 1.5), 0.2
"""Factor of the grey levels around their mean, and the largest brightness added, 0 to 1."""
COUNTED_PX = 256
"""Edges are counted in the lower left corner of each landscape, of this size."""
BLUR_STD_PX, BLUR_PX = 1.0, 7
"""Edges are compared smoothed by a Gaussian; predictions in a window of this size."""
STRAIGHT = 0.4
"""Value of a straight edge, smoothed: 1 / sqrt(2 pi)."""
RARE = -2.5
"""Logits start at the share of edges, so that the first steps do not learn it."""
AGREEMENT = 0.5
"""Weight of the agreement of two dates in the loss."""
SAID_EVERY = 100
OPSET, IR_VERSION = 17, 8
Dates = list[NDArray[np.uint8]]
Agreement = dict[str, Any]


def network() -> nn.Sequential:
    """Convolutions without padding: grey levels (N, 1, H + 2 m, W + 2 m) to logits (N, 1, H, W)."""
    layers: list[nn.Module] = [nn.Conv2d(1, WIDTH, 5), nn.ReLU(inplace=True)]
    for dilation in DILATIONS:
        layers += [nn.Conv2d(WIDTH, WIDTH, 3, dilation=dilation), nn.ReLU(inplace=True)]
    last = nn.Conv2d(WIDTH, 1, 1)
    nn.init.constant_(last.bias, RARE)  # type: ignore[arg-type]  # it has a bias
    return nn.Sequential(*layers, last)


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


def lasting(dates: Dates) -> NDArray[np.float32]:
    """Edges (H, W) that all dates have, 0 to 1: the least of the dates' blurred Canny edges.

    A straight edge that all have in the same place is 1.
    """
    least = np.minimum.reduce([blurred(canny(grey)) for grey in dates])
    return np.asarray(np.clip(least / STRAIGHT, 0, 1), np.float32)


def blurred(edges: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Edges (H, W) smoothed, so that those a pixel apart agree."""
    return np.asarray(cv2.GaussianBlur(edges.astype(np.float32), (0, 0), BLUR_STD_PX), np.float32)


def batches(
    areas: Sequence[Dates], margin: int, steps: int
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Crops of two dates, each in a light of its own, and the edges of all dates.

    The first half of a batch (2 * PAIRS, 1, S, S) is of one date, the second of another, in the
    same order; edges (2 * PAIRS, 1, CROP_PX, CROP_PX).
    """
    targets = [lasting(dates) for dates in areas]
    rng = np.random.default_rng(0)
    side = CROP_PX + 2 * margin
    for _ in range(steps):
        seen = np.empty((2, PAIRS, 1, side, side), np.float32)
        wanted = np.empty((PAIRS, 1, CROP_PX, CROP_PX), np.float32)
        for row in range(PAIRS):
            area = int(rng.integers(len(areas)))
            two = rng.permutation(len(areas[area]))[:2]
            y, x = (int(rng.integers(size - side + 1)) for size in targets[area].shape)
            turns, mirrored = int(rng.integers(4)), int(rng.choice([-1, 1]))
            for number, date in enumerate(two):
                part = areas[area][date][y : y + side, x : x + side].astype(np.float32) / 255
                lit = relit(part, rng)
                seen[number, row, 0] = np.rot90(lit, turns)[:, ::mirrored]
            inner = targets[area][y + margin : y + side - margin, x + margin : x + side - margin]
            wanted[row, 0] = np.rot90(inner, turns)[:, ::mirrored]
        pictures = torch.from_numpy(seen.reshape(-1, 1, side, side))
        yield pictures, torch.from_numpy(np.concatenate([wanted, wanted]))


def relit(part: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Grey levels (H, W), 0 to 1, with another contrast and brightness."""
    level = part.mean()
    lit = level + (part - level) * rng.uniform(*GAIN) + rng.uniform(-OFFSET, OFFSET)
    return np.asarray(np.clip(lit, 0, 1), np.float32)


def correlation(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Correlation coefficient of two predictions (N, 1, H, W), smoothed as in `agreement`."""
    line = torch.from_numpy(cv2.getGaussianKernel(BLUR_PX, BLUR_STD_PX).astype(np.float32))
    kernel = (line @ line.T)[None, None]
    a, b = (each - each.mean() for each in (functional.conv2d(p, kernel) for p in (one, other)))
    return (a * b).mean() / (a.square().mean() * b.square().mean() + 1e-10).sqrt()


def loss_of(found: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """Cross-entropy of logits (2 N, 1, H, W), and how little those of two dates agree."""
    entropy = functional.binary_cross_entropy_with_logits(found, wanted)
    one, other = torch.sigmoid(found).chunk(2)
    return entropy + AGREEMENT * (1 - correlation(one, other))


def learn(areas: Sequence[Dates], steps: int = STEPS) -> nn.Sequential:
    """The network, with as many edges as Canny finds in the landscapes."""
    torch.manual_seed(0)
    model = network()
    margin = margin_px(model)
    optimizer = torch.optim.Adam(model.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    quick = mixed_precision(Means(), torch.device("cpu")) is not None
    start, losses = time.monotonic(), []
    for step, (seen, wanted) in enumerate(batches(areas, margin, steps), start=1):
        with torch.autocast("cpu", torch.bfloat16, enabled=quick):
            found = model(seen)
        loss = loss_of(found.float(), wanted)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # PyTorch's
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if step % SAID_EVERY == 0 or step == steps:
            mean, took_s = np.mean(losses[-SAID_EVERY:]), time.monotonic() - start
            print(f"step {step} of {steps}, loss {mean:.4f}, {took_s:.0f} s", flush=True)
    parts = [grey[-COUNTED_PX:, :COUNTED_PX] for dates in areas for grey in dates]
    return cut_off(model, parts)


def cut_off(model: nn.Sequential, pictures: Dates) -> nn.Sequential:
    """The network, in place, with as many edges as Canny finds in pictures."""
    share = float(np.mean([canny(grey).mean() for grey in pictures]))
    found = np.concatenate([logits(model, grey).ravel() for grey in pictures])
    last: Any = model[-1]
    with torch.no_grad():
        last.bias -= float(np.quantile(found, 1 - share))
    return model.eval()


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
    return float(np.corrcoef(blurred(one).ravel(), blurred(other).ravel())[0, 1])


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


def agreements(model: nn.Sequential, area: tuple[int, float], dates: Dates) -> Iterator[Agreement]:
    """How the edges of two dates agree, Canny's and learnt ones, for each pair of dates."""
    learnt = [(logits(model, grey) > 0).astype(np.uint8) for grey in dates]
    plain = [canny(grey) for grey in dates]
    for one, other in combinations(range(len(dates)), 2):
        yield {
            "seed": area[0],
            "gsd_m": area[1],
            "dates": [DEFAULT_DATES[each].name for each in (one, other)],
            "canny": round(agreement(plain[one], plain[other]), 3),
            "learnt": round(agreement(learnt[one], learnt[other]), 3),
            "share_canny": round(float(np.mean([plain[one], plain[other]])), 3),
            "share_learnt": round(float(np.mean([learnt[one], learnt[other]])), 3),
        }


def write_agreements(found: Sequence[Agreement], path: Path) -> None:
    """Write them beside the network, from where the page of results takes them."""
    text = ",\n".join(json.dumps(each) for each in found)
    write_text(path.with_suffix(".json"), f"[\n{text}\n]\n")


def main() -> None:
    """Generate the landscapes, learn, write, and say how the edges of two dates agree."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.paper.between_dates", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--out", type=Path, default=BETWEEN_DATES, metavar="FILE.onnx")
    parser.add_argument("--steps", type=int, default=STEPS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="orthonav-dates-") as folder:
        made = {each: landscape(*each, Path(folder) / str(each[0])) for each in (*AREAS, *HELD_OUT)}
    model = learn([made[each] for each in AREAS], options.steps)
    write(model, options.out)
    print(f"{sum(each.numel() for each in model.parameters()):,} parameters: {options.out}")
    found = [pair for area in HELD_OUT for pair in agreements(model, area, made[area])]
    write_agreements(found, options.out)
    for each in found:
        print(
            f"{each['gsd_m']:g} m per pixel, not learnt from, correlation of "
            f"{' and '.join(each['dates'])}: Canny {each['canny']:.2f}, learnt {each['learnt']:.2f}"
        )


if __name__ == "__main__":
    main()
