"""Train the segmentation network that comes with rigwake.

    python benchmarks/train_segmentation.py render DATA --scenes 20        # rigwake's own environment
    python benchmarks/train_segmentation.py fit DATA MODEL.onnx --epochs 20 # any environment with torch, numpy and cv2

`render` draws random scenes (`segmentation_scenes.py`); `fit` trains on them and writes the ONNX file. Every epoch sees
each picture through another camera, in other light and other weather: diversity, not the number of epochs, is what
makes the network find real boats. The same scenes and seed give the same accuracy to about 1 %.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

WATER, OBSTACLE, SKY, IGNORED = 0, 1, 2, 255
_ROWS, _COLUMNS = 160, 224  # that are trained on
_LEAST_WATER = 0.1
# Obstacles weigh more in the loss, so they come out too likely; so much is taken off their logit when the model is
# written. Chosen among 0, 0.4, 0.6, 0.75, 1 on the four frames of a real river that serve to choose.
_LESS_OBSTACLE = 0.6
_SMALL_PX = 350  # of a thing on the water


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int]) -> np.ndarray:
    """(H, W) smooth noise of unit deviation, roughly, with so many cells down and across."""
    coarse = rng.standard_normal(cells).astype(np.float32)
    return cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)


def repaint(
    light: np.ndarray, ranges: np.ndarray, labels: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The same scene of other materials in other air: tints per class, turbid water, overcast sky, foam, haze."""
    water, obstacle, sky = (labels == c for c in (WATER, OBSTACLE, SKY))
    shape = labels.shape
    sky_light = light[sky].mean(axis=0) if sky.any() else np.array([0.6, 0.7, 0.8], np.float32)
    light[water] *= rng.uniform(0.5, 1.5) * rng.uniform(0.8, 1.2, 3)
    if rng.random() < 0.35:  # turbid: light from within
        body = np.array(((0.05, 0.09, 0.08), (0.12, 0.11, 0.06), (0.03, 0.09, 0.12))[rng.integers(3)])
        amount = rng.uniform(0.1, 0.6)
        light[water] = (1 - amount) * light[water] + amount * body * rng.uniform(
            0.5, 2
        ) * sky_light.mean() * 2
    if rng.random() < 0.3:
        light[obstacle] *= rng.uniform(0.45, 1.6) * rng.uniform(0.8, 1.2, 3)
    if rng.random() < 0.4:
        grain = smooth_noise(rng, shape, (int(rng.integers(10, 80)), int(rng.integers(10, 120))))
        light *= np.where(obstacle, np.exp(rng.uniform(0.1, 0.5) * grain), 1)[..., None]
    if rng.random() < 0.4:  # overcast
        cloud = np.exp(0.25 * smooth_noise(rng, shape, (6, 5)))[..., None] * rng.uniform(0.5, 1.5)
        amount = rng.uniform(0.4, 1.0)
        light[sky] = ((1 - amount) * light + amount * cloud * np.array([0.9, 0.95, 1.0]))[sky]
    if (
        rng.random() < 0.25
    ):  # the glitter path of the sun: specks, wider and longer than high the nearer they are
        light = light + glitter(rng, shape, water)[..., None] * sky_light.mean() * rng.uniform(2, 25)
    if rng.random() < 0.25:  # foam and wakes: long across, thin down
        foam = smooth_noise(rng, shape, (int(rng.integers(20, 70)), int(rng.integers(4, 16))))
        foam = foam + 0.7 * smooth_noise(rng, shape, (80, 70))
        amount = np.clip((foam - rng.uniform(1.0, 2.2)) * 2, 0, 1) * water * rng.uniform(0.3, 1)
        light = light * (1 - amount[..., None]) + amount[..., None] * rng.uniform(0.4, 1.2)
    if rng.random() < 0.5:
        clear = np.exp(-np.minimum(ranges, 1e5) / np.exp(rng.uniform(np.log(80), np.log(4000))))[..., None]
        air = sky_light * rng.uniform(0.7, 1.1) if sky.any() else sky_light * 0.8
        light = light * clear + (1 - clear) * air
    return light.astype(np.float32)


def set_afloat(
    light: np.ndarray, ranges: np.ndarray, labels: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same picture with a few more small things on its water (buoys, heads, posts, boards), shaded from one side,
    each above its mirror image."""
    light, ranges, labels = light.copy(), ranges.copy(), labels.copy()
    rows, columns = labels.shape
    bright = float(np.median(light)) + 1e-3
    for _ in range(int(rng.integers(1, 6))):
        foot, middle = int(rng.integers(4, rows)), int(rng.integers(0, columns))
        if labels[foot, middle] != WATER:
            continue
        half, high = rng.uniform(1.5, 11), rng.uniform(3, 26)
        top = max(foot - int(high), 0)
        r = np.arange(top, min(foot + int(high), rows))
        above = r <= foot
        up = np.abs(foot - r) / high  # of the thing, and of its mirror image
        power = rng.choice([0.0, 0.5, 1.0])  # a post, a ball, a cone
        wide = half * (1 - up.clip(0, 1) ** 2) ** 0.5 if power == 0.5 else half * (1 - 0.8 * power * up)
        wide = wide + np.where(above, 0, rng.normal(0, 0.18 * half, len(r)))  # ripples
        c = np.arange(max(middle - 12, 0), min(middle + 13, columns))
        inside = np.abs(c[None, :] - middle) <= wide[:, None]
        colour = rng.uniform(0.05, 1.0, 3) if rng.random() < 0.7 else np.full(3, rng.uniform(0.1, 1.3))
        shade = 1 + rng.uniform(-0.6, 0.6) * (c - middle)[None, :] / half
        shade = shade * np.exp(0.15 * rng.standard_normal((len(r), len(c))))
        if rng.random() < 0.3:
            shade = (
                shade * np.where((up * rng.uniform(2, 5)).astype(int) % 2, rng.uniform(0.2, 2.5), 1)[:, None]
            )
        drawn = (bright * rng.uniform(0.4, 3) * shade)[..., None].clip(0) * colour
        area = np.ix_(r, c)
        cover = np.where(above, 1.0, rng.uniform(0, 0.6) * (1 - up).clip(0))[:, None] * inside
        cover = cover * (np.where(above[:, None], True, labels[area] == WATER))
        light[area] = light[area] * (1 - cover[..., None]) + cover[..., None] * drawn
        solid = inside & above[:, None]
        ranges[area] = np.where(solid, ranges[foot, middle], ranges[area])
        labels[area] = np.where(solid, OBSTACLE, labels[area])
    return light, ranges, labels


def glitter(rng: np.random.Generator, shape: tuple[int, int], water: np.ndarray) -> np.ndarray:
    """(H, W) in 0..1: where a low sun glitters on the water, in a path below the sun."""
    rows, columns = shape
    down = np.arange(rows, dtype=np.float32)[:, None] / rows
    half = columns * rng.uniform(0.01, 0.09) * (0.4 + rng.uniform(0, 2.5) * down)
    across = (np.arange(columns, dtype=np.float32)[None, :] - rng.uniform(0, columns)) / half
    specks = smooth_noise(rng, shape, (int(rng.integers(40, 160)), int(rng.integers(20, 110))))
    path = np.exp(-0.5 * across**2)
    lit = np.clip((specks + rng.uniform(-1.5, 3.0) * path - rng.uniform(0.5, 2.0)) * rng.uniform(1, 4), 0, 1)
    return (lit * path * water).astype(np.float32)


def photograph(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An 8-bit BGR picture by a random camera: exposure, white balance, response, saturation, blur, noise, JPEG."""
    rows, columns = light.shape[:2]
    light = light * rng.uniform(0.85, 1.18, 3).astype(np.float32)
    middle = float(np.percentile(light, rng.uniform(40, 70)))
    exposed = np.clip(light * rng.uniform(0.1, 0.5) / max(middle, 1e-3), 0, None)
    if rng.random() < 0.6:  # shoulder
        exposed = exposed * (2.51 * exposed + 0.03) / (exposed * (2.43 * exposed + 0.59) + 0.14)
    picture = np.clip(exposed, 0, 1) ** (1 / rng.uniform(1.5, 2.6))
    grey = picture.mean(axis=2, keepdims=True)
    picture = grey + rng.choice([rng.uniform(0.3, 1.5), 1.0, 0.0], p=[0.7, 0.25, 0.05]) * (picture - grey)
    if rng.random() < 0.4:
        y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
        around = (x - rng.uniform(-0.5, 0.5)) ** 2 + (y - rng.uniform(-0.5, 0.5)) ** 2
        picture = picture * (1 - rng.uniform(0, 0.3) * around)[..., None]
    picture = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), rng.uniform(0.35, 1.3))
    picture = picture + rng.uniform(0, 0.035) * rng.standard_normal(picture.shape, dtype=np.float32)
    stored = (255 * np.clip(picture[..., ::-1], 0, 1)).astype(np.uint8)
    if rng.random() < 0.7:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 95))]
        stored = cv2.imdecode(cv2.imencode(".jpg", stored, quality)[1], cv2.IMREAD_COLOR)
    return stored


def network_input(picture: np.ndarray, is_seen: np.ndarray, elevation_deg: np.ndarray | None) -> np.ndarray:
    """(4, H, W) float32, exactly as `rigwake.views.scene.network.network_input` makes it (a test compares them)."""
    scaled = picture.astype(np.float32) / 255
    known = scaled[is_seen]
    mean, std = (float(known.mean()), float(known.std())) if known.size else (0.0, 1.0)
    channels = np.zeros((4, *picture.shape[:2]), np.float32)
    channels[:3] = np.moveaxis((scaled - mean) / (std + 0.05) * is_seen[..., None], -1, 0)
    if elevation_deg is not None:
        channels[3] = np.clip(elevation_deg / 20, -2, 2)[:, None]
    return channels


def cut_out(stored: dict[str, np.ndarray], k: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """A window of picture `k` anywhere, zoomed to the size that is trained on: where something lies in the picture must
    not tell what it is. Light, ranges, labels, and elevations (ROWS,) in degrees."""
    rows, columns = stored["labels"].shape[1:]
    zoom = float(np.exp(rng.uniform(np.log(_ROWS / rows), np.log(2.2))))
    high, wide = _ROWS / zoom, min(_COLUMNS / zoom, columns)
    top, left = rng.uniform(0, rows - high), rng.uniform(0, columns - wide)
    r = np.clip((top + (np.arange(_ROWS) + 0.5) / zoom).astype(int), 0, rows - 1)
    c = np.clip((left + (np.arange(_COLUMNS) + 0.5) * wide / _COLUMNS).astype(int), 0, columns - 1)
    light, ranges, labels = (stored[name][k][r][:, c] for name in ("light", "ranges_m", "labels"))
    if zoom > 1.2:  # no blocks of equal pixels
        light = cv2.GaussianBlur(light.astype(np.float32), (0, 0), 0.45 * zoom)
    elevation = stored["top_deg"][k] - (top + (np.arange(_ROWS) + 0.5) / zoom) * stored["step_deg"][k]
    return light.astype(np.float32), ranges.astype(np.float32), labels.copy(), elevation


class Examples:
    """Pictures as the network sees them, another way every time."""

    def __init__(self, paths: list[Path], seed: int, epochs: int, is_varied: bool = True) -> None:
        self.stores = [np.load(path, allow_pickle=False) for path in paths]
        self.arrays = [
            {k: s[k] for k in ("light", "ranges_m", "labels", "top_deg", "step_deg")} for s in self.stores
        ]
        self.index = [(i, k) for i, a in enumerate(self.arrays) for k in range(len(a["labels"]))]
        self.seed, self.epochs, self.is_varied = seed, epochs, is_varied

    def __len__(self) -> int:
        return self.epochs * len(self.index)

    def __getitem__(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        epoch, at = divmod(number, len(self.index))
        order = np.random.default_rng([self.seed, epoch]).permutation(len(self.index))
        scene, k = self.index[order[at]]
        stored = self.arrays[scene]
        rng = np.random.default_rng([self.seed, epoch, int(order[at])])
        for _ in range(3):  # pictures without water teach little
            light, ranges, labels, elevation = cut_out(stored, k, rng)
            if (labels == WATER).mean() > _LEAST_WATER:
                break
        if rng.random() < 0.5:
            light, ranges, labels = set_afloat(light, ranges, labels, rng)
        picture = photograph(repaint(light, ranges, labels, rng), rng)
        elevation = elevation + rng.normal(0, 0.8)
        rows, columns = labels.shape
        weight = np.ones(labels.shape, np.float32)
        weight[(labels == OBSTACLE) & (elevation < -0.5)[:, None]] = 1.5
        _, pieces, sizes, _ = cv2.connectedComponentsWithStats((labels == OBSTACLE).astype(np.uint8))
        is_small = sizes[:, cv2.CC_STAT_AREA] < _SMALL_PX
        is_small[0] = False
        weight[is_small[pieces]] = 4.0  # or the few pixels of a buoy never count
        edge = cv2.morphologyEx(
            (labels == WATER).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)
        )
        weight += 2.0 * edge
        is_seen = np.ones(labels.shape, bool)
        if rng.random() < 0.3:  # the own hull, or where no camera looks
            wave = smooth_noise(rng, (1, columns), (1, 6))[0] * rows * 0.1
            is_seen = np.arange(rows)[:, None] < rows * rng.uniform(0.6, 1.0) + wave[None, :]
            labels[~is_seen] = IGNORED
        if rng.random() < 0.5:
            picture, labels, is_seen, weight = (a[:, ::-1].copy() for a in (picture, labels, is_seen, weight))
        channels = network_input(picture, is_seen, None if rng.random() < 0.5 else elevation)
        return channels, labels.astype(np.int64), weight


def build_network(torch: Any) -> Any:
    """Encoder to 1/32 with wide context, light decoder to 1/2: logits (N, 3, H, W) of (N, 4, H, W)."""
    nn = torch.nn

    def block(i: int, o: int, stride: int = 1, dilation: int = 1, groups: int = 1) -> Any:
        conv = nn.Conv2d(i, o, 3, stride, dilation, dilation, groups, bias=False)
        return nn.Sequential(conv, nn.BatchNorm2d(o), nn.ReLU(inplace=True))

    def point(i: int, o: int) -> Any:
        return nn.Sequential(nn.Conv2d(i, o, 1, bias=False), nn.BatchNorm2d(o))

    class Residual(nn.Module):  # type: ignore[name-defined,misc]
        def __init__(self, width: int, dilation: int = 1) -> None:
            super().__init__()
            self.body = nn.Sequential(
                block(width, width, 1, dilation, width),
                point(width, 2 * width),
                nn.ReLU(),
                point(2 * width, width),
            )

        def forward(self, x: Any) -> Any:
            return torch.relu(x + self.body(x))

    class Segmenter(nn.Module):  # type: ignore[name-defined,misc]
        def __init__(self) -> None:
            super().__init__()
            self.first = block(4, 8, 2)
            self.quarter = nn.Sequential(block(8, 20, 2), Residual(20))
            self.eighth = nn.Sequential(block(20, 36, 2), Residual(36), Residual(36))
            self.sixteenth = nn.Sequential(block(36, 56, 2), Residual(56), Residual(56, 2))
            self.lowest = nn.Sequential(block(56, 56, 2), Residual(56), Residual(56, 2), Residual(56, 3))
            self.skips = nn.ModuleList([point(w, o) for w, o in ((56, 36), (36, 28), (20, 20), (8, 8))])
            self.downs = nn.ModuleList([point(i, o) for i, o in ((56, 36), (36, 28), (28, 20), (20, 8))])
            self.mixes = nn.ModuleList([block(36, 36), block(28, 28), block(20, 20), block(8, 8, groups=8)])
            self.logits = nn.Conv2d(8, 3, 1)

        def forward(self, x: Any) -> Any:
            levels = [self.first(x)]
            for stage in (self.quarter, self.eighth, self.sixteenth):
                levels.append(stage(levels[-1]))
            up = self.lowest(levels[-1])
            for skip, down, mix, level in zip(self.skips, self.downs, self.mixes, levels[::-1], strict=True):
                up = nn.functional.interpolate(down(up), scale_factor=2, mode="bilinear", align_corners=False)
                up = mix(torch.relu(up + skip(level)))
            return nn.functional.interpolate(
                self.logits(up), scale_factor=2, mode="bilinear", align_corners=False
            )

    return Segmenter()


def fit(folder: Path, model: Path, epochs: int, seed: int, budget_s: float) -> None:
    """Train on all scenes of a folder for so many epochs, and write the ONNX file."""
    import torch

    torch.manual_seed(seed)
    torch.set_num_threads(1)  # more spend their time waiting for each other
    paths = sorted(folder.glob("scene_*.npz"))
    examples = Examples(paths, seed, epochs)
    batch = 8
    loader = torch.utils.data.DataLoader(examples, batch, shuffle=False, num_workers=2, drop_last=True)
    network = build_network(torch).to(memory_format=torch.channels_last)
    average = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.98), use_buffers=True
    )
    optimiser = torch.optim.AdamW(network.parameters(), 4e-3, weight_decay=1e-3)
    steps = len(loader)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 6e-3, total_steps=steps + 1, pct_start=0.15)
    parameters = sum(p.numel() for p in network.parameters())
    print(f"{len(examples.index)} pictures, {steps} steps, {parameters} parameters", flush=True)
    started, losses = time.process_time(), []
    for step, (channels, labels, weight) in enumerate(loader):
        logits = network(channels.to(memory_format=torch.channels_last))
        each = torch.nn.functional.cross_entropy(logits, labels, ignore_index=IGNORED, reduction="none")
        loss = (each * weight).sum() / weight[labels != IGNORED].sum()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        optimiser.step()
        schedule.step()
        average.update_parameters(network)
        losses.append(float(loss.detach()))
        if step % 25 == 0:
            spent = time.process_time() - started
            print(f"{step}/{steps} loss {np.mean(losses[-25:]):.3f}, {spent:.0f} CPU-s", flush=True)
        if step % 100 == 99 or step == steps - 1:
            write_onnx(torch, average.module, model)
        if time.process_time() - started > budget_s:
            print("the budget is spent")
            break
    write_onnx(torch, average.module, model)
    spent = time.process_time() - started
    facts = {
        "scenes": len(paths), "pictures": len(examples.index), "epochs": epochs, "seed": seed, "steps": len(losses),
        "parameters": parameters, "cpu_s_main_process": round(spent),
        "loss_of_last_50": round(float(np.mean(losses[-50:])), 4),
    }  # fmt: skip
    model.with_suffix(".json").write_text(json.dumps(facts, indent=2) + "\n")


def write_onnx(torch: Any, network: Any, path: Path) -> None:
    """Export with any batch, height and width (multiples of 32)."""
    import copy
    import warnings

    network = copy.deepcopy(network).eval()
    with torch.no_grad():
        network.logits.bias[OBSTACLE] -= _LESS_OBSTACLE
    axes = {0: "batch", 2: "rows", 3: "columns"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, (torch.zeros(1, 4, 192, 320),), str(path), dynamo=False, opset_version=13,
            input_names=["channels"], output_names=["logits"], dynamic_axes={"channels": axes, "logits": axes},
        )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("step", choices=("render", "fit"))
    parser.add_argument("folder", type=Path, help="of the rendered scenes")
    parser.add_argument("model", type=Path, nargs="?", help="ONNX file to write")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--budget-s", type=float, default=900.0, help="CPU seconds after which training stops"
    )
    options = parser.parse_args()
    if options.step == "render":
        from segmentation_scenes import render_scene

        options.folder.mkdir(parents=True, exist_ok=True)
        for number in range(options.scenes):
            path = options.folder / f"scene_{number:04d}.npz"
            if not path.exists():
                render_scene(number).save(path)
    else:
        if options.model is None:
            parser.error("fit needs the ONNX file to write")
        fit(options.folder, options.model, options.epochs, options.seed, options.budget_s)


if __name__ == "__main__":
    main()
