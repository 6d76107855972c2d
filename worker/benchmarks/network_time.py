"""`spicd-worker bench-network`: how long SPICD-Net's network takes for the tiles of a map, beside its floor.

What is timed is the network on arrays that lie on the device: one side of every pair encoded, the map's descriptors being
kept, and the head on all pairs. The floor is the time that the multiplications of the layers take at the rate which the
device reaches, in the same run and the same precision, on a product of two large square matrices; nothing that is read or
written counts. Compiled code and CUDA graphs are measured here before anything is run by them: by default nothing is.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import torch
from rich.table import Table
from torch import Tensor

from worker.benchmarks.documents import Document, spread, titled_table
from worker.benchmarks.timing import machine, processor_name
from worker.detectors.card import MODEL_STORE
from worker.detectors.precision import Precision, chosen_precision
from worker.detectors.siamese.chamfer import chamfer_statistics
from worker.detectors.siamese.layers import NormedLinear
from worker.detectors.spicd_net.network import PointEncoder, SpicdNetwork
from worker.detectors.spicd_net.together import TogetherEncoder
from worker.detectors.store import Device, open_detector, resolve_device, weights_of
from worker.progress import Progress, no_progress

Encode = Callable[[Tensor, Tensor], Tensor]  #: points (B, N, 3) and centroids (B, 3) to descriptors (B, 1024)

_WARM = 3  #: turns that are not counted
_CHAMFER_TILES = 8  #: that the distances are timed on


@dataclass(frozen=True, kw_only=True, slots=True)
class NetworkTimeSettings:
    """What is run."""

    device: Device = "auto"
    precision: Precision = "float32"
    compiled: bool = False  #: by torch.compile
    graphs: bool = False  #: recorded once as a CUDA graph, and played back
    tiles: int = 172  #: of the paper's map
    points: int = 4096  #: of each tile, all distinct
    batch: int = 64  #: tiles of one product
    repeats: int = 20
    square: int = 4096  #: edge of the matrices that the device's rate is measured with
    backend: str = "inductor"  #: of torch.compile
    model: str = "spicd-net/1"
    model_store: Path = MODEL_STORE


def measure(settings: NetworkTimeSettings, progress: Progress = no_progress) -> Document:
    """Return the figures, JSON-ready. Raises DetectorUnavailable, and ValueError for CUDA graphs without a GPU."""
    device = resolve_device(settings.device)
    chosen_precision(settings.precision, device, holds=True)
    if settings.graphs and device.type != "cuda":
        raise ValueError("CUDA graphs need a GPU: leave out --graphs, or give --device cuda")
    network = SpicdNetwork().eval()
    network.load_state_dict(weights_of(open_detector(settings.model_store, settings.model, "cpu")))
    network.to(device)
    encoder = TogetherEncoder(network.encoder, settings.precision).to(device).eval()
    points = torch.rand(settings.tiles, settings.points, 3, device=device) - 0.5
    with torch.inference_mode():
        encode = _prepared(encoder, points, settings)
        progress("network", 0.1)
        times = _milliseconds(lambda: _run(encode, network, points, settings.batch), settings.repeats, device)
        progress("floor", 0.8)
        rate = _rate(settings.square, settings.precision, device)
        distances = _milliseconds(lambda: _distances(points), settings.repeats, device)
    floor = 1000 * operations(network.encoder, points=settings.points, tiles=settings.tiles) / rate
    median = cast("dict[str, float]", spread(times, "median"))["median"]
    progress("floor", 1.0)
    return {
        "machine": machine(torch=torch.__version__, device=_name(device)),
        "settings": {name: _plain(value) for name, value in asdict(settings).items()},
        "network_ms": spread(times, "median", "least", "most"),
        "floor_ms": floor,
        "times_floor": median / floor,
        "rate_tflops": rate / 1e12,
        "operations": operations(network.encoder, points=settings.points, tiles=settings.tiles),
        "chamfer_ms_a_tile": cast("dict[str, float]", spread(distances, "median"))["median"] / _CHAMFER_TILES,
        "gpu_memory_mb": round(torch.cuda.max_memory_allocated() / 2**20) if device.type == "cuda" else None,
    }


def operations(encoder: PointEncoder, *, points: int, tiles: int) -> float:
    """Return the floating-point operations of encoding `tiles` clouds of `points`: two for each weight and point.

    Only the layers that each point goes through; those of a cloud are less than a thousandth of them.
    """
    transforms = (encoder.input_transform, encoder.feature_transform)
    layers: list[NormedLinear] = [encoder.mlp1, encoder.mlp2, encoder.mlp3, encoder.mlp4]
    layers += [layer for net in transforms for layer in (net.points1, net.points2, net.pooled)]
    return 2.0 * tiles * points * sum(layer.weight.numel() for layer in layers)


def _prepared(encoder: TogetherEncoder, points: Tensor, settings: NetworkTimeSettings) -> Encode:
    """Return the encoder as it shall be run."""
    run: Encode = encoder
    if settings.compiled:
        run = cast("Encode", torch.compile(encoder, dynamic=False, backend=settings.backend))
    if settings.graphs:
        return _recorded(run, points[: settings.batch])
    return run


def _recorded(run: Encode, points: Tensor) -> Encode:
    """Return what plays a CUDA graph of one batch (PyTorch, "CUDA semantics", whole-network capture).

    The last batch of a map is filled up with tiles of the one before.
    """
    inputs = points.clone(), points.mean(dim=1)
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(_WARM):
            run(*inputs)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        output = run(*inputs)

    def play(batch: Tensor, centroids: Tensor) -> Tensor:
        inputs[0][: len(batch)].copy_(batch)
        inputs[1][: len(batch)].copy_(centroids)
        graph.replay()
        return output[: len(batch)].clone()

    return play


def _run(encode: Encode, network: SpicdNetwork, points: Tensor, batch: int) -> Tensor:
    """Encode one side in batches and classify all pairs: (T, 3)."""
    descriptors = torch.cat([encode(part, part.mean(dim=1)) for part in torch.split(points, batch)])
    statistics = torch.zeros(len(points), 8, device=points.device)
    logits: Tensor = network.head(descriptors, descriptors, statistics)
    return logits.softmax(dim=1)


def _distances(points: Tensor) -> Tensor:
    clouds = list(points[:_CHAMFER_TILES])
    return chamfer_statistics(clouds, clouds)


def _milliseconds(run: Callable[[], Tensor], repeats: int, device: torch.device) -> list[float]:
    """Time a run from an idle device to its result."""
    times = []
    for turn in range(_WARM + repeats):
        _wait_for(device)
        begun = time.perf_counter()
        run()
        _wait_for(device)
        if turn >= _WARM:
            times.append(1000 * (time.perf_counter() - begun))
    return times


def _rate(edge: int, precision: Precision, device: torch.device) -> float:
    """Return the floating-point operations a second that the device reaches on a product of square matrices."""
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    a = torch.rand(edge, edge, device=device).to(dtype)
    return 1000 * 2.0 * edge**3 / min(_milliseconds(lambda: a @ a, 5, device))


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


def _name(device: torch.device) -> str:
    return torch.cuda.get_device_name() if device.type == "cuda" else processor_name()


def _plain(value: object) -> object:
    return str(value) if isinstance(value, Path) else value


def table(figures: Document) -> Table:
    """Show the figures on a terminal."""
    asked, took = figures["settings"], figures["network_ms"]
    ways = [name for name in ("compiled", "graphs") if asked[name]]
    title = f"{asked['tiles']} tiles of {asked['points']} points, {', '.join([asked['precision'], *ways])}"
    rows = (
        (
            "network, one side and the head",
            f"{took['median']:.2f} ({took['least']:.2f} to {took['most']:.2f})",
        ),
        (f"floor, at {figures['rate_tflops']:.1f} Tflop/s", f"{figures['floor_ms']:.2f}"),
        ("network over floor", f"{figures['times_floor']:.1f}"),
        ("distances of a tile", f"{figures['chamfer_ms_a_tile']:.3f}"),
    )
    return titled_table(title, (figures["machine"]["device"], "ms"), rows)
