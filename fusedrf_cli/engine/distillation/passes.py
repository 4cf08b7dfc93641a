"""One pass over a batch of rays per field kind: render, compare with the pictures, leave the gradient.

The loss of a batch of n rays is mean (C + (1 - A) background - target)² over rays and channels, plus
opacity_weight times mean (A - alpha)², with A the opacity. Every pass returns the sums (3,) of the colour
term (a ray's mean over channels), of the opacity term, and of the work done, in samples of the `vm` kind.
"""

from typing import NamedTuple, Protocol

import numpy as np
import torch

from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.kinds.vm_mlp.field import VMMLPField
from fusedrf_cli.engine.rendering.volume import waves, weights_from_sigma

NETWORK_RATE = 1e-3  # TensoRF's
BETAS = (0.9, 0.99)
THIN_BELOW = 1 / 64  # weight under which some samples are shaded for all; 0: every one is
SCATTER = 7919.0  # makes of a ray's jitter another random number
SHADING_COST = 8  # a sample with the network over one without: keeps steps short and many


class Pass(Protocol):
    """What a fit asks of a field kind."""

    def gradient(self, field, batch: Batch, grads: np.ndarray) -> np.ndarray:
        """Add the gradient of `field.params` to the rows of grads (parts, P); returns the sums (3,)."""
        ...

    def step(self, decay: float) -> None:
        """Move what is not in `field.params`, at `decay` times the first rate."""
        ...

    def numbers(self) -> list[torch.Tensor]:
        """Views of what `step` changes."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """What a checkpoint has to keep besides the field."""
        ...

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Inverse of `state`."""
        ...


class FusedPass:
    """The `vm` kind's: forward and backward of a ray in one kernel."""

    def __init__(self, field: VMField):
        pass

    def gradient(self, field: VMField, batch: Batch, grads: np.ndarray) -> np.ndarray:
        """See Pass."""
        loss = np.zeros((grads.shape[0], 3))
        field.train_rays(batch, grads, loss)
        return loss.sum(0)

    def step(self, decay: float) -> None:
        """Nothing: all is in `params`."""

    def numbers(self) -> list[torch.Tensor]:
        """Nothing."""
        return []

    def state(self) -> dict[str, np.ndarray]:
        """Nothing."""
        return {}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Nothing."""


class PackedPass:
    """The `vm-mlp` kind's: samples of all rays in one list, one run of the network over those seen."""

    def __init__(self, field: VMMLPField):
        self.optimiser = torch.optim.Adam(field.network.parameters(), NETWORK_RATE, BETAS)
        for weight in field.network.parameters():  # moments that are there from the start can be copied
            zero = {name: torch.zeros_like(weight) for name in ("exp_avg", "exp_avg_sq")}
            self.optimiser.state[weight] = {"step": torch.tensor(0.0), **zero}

    def gradient(self, field: VMMLPField, batch: Batch, grads: np.ndarray) -> np.ndarray:
        """See Pass; the network's gradient stays with its weights until `step`."""
        n = len(batch.rays_o)
        ray, ts = visible_samples(field, batch)
        dirs = batch.rays_d[ray]
        points = torch.from_numpy(batch.rays_o[ray] + ts[:, None] * dirs)
        ray, dirs = torch.from_numpy(ray), torch.from_numpy(dirs)
        params = field.params.detach().requires_grad_()
        basis = (
            field.basis.detach().requires_grad_()
        )  # a leaf of its own: a slice's gradient is as large as params

        sigma = autograd.density(field, params, points, dirs, grads)
        weights, opacity = composite(sigma * batch.step, ray, n)
        seen, share = shaded_samples(weights.detach(), ray, torch.from_numpy(batch.jitter))
        rgb = field.shade(autograd.features(field, params, points[seen], grads), dirs[seen], basis)
        colour = rgb.new_zeros(n, 3).index_add(0, ray[seen], (weights[seen] / share)[:, None] * rgb)

        target = torch.from_numpy(batch.target)
        error = colour + (1 - opacity)[:, None] * torch.from_numpy(batch.background) - target[:, :3]
        losses = (error**2).mean(1).sum(), ((opacity - target[:, 3]) ** 2).sum()
        self.optimiser.zero_grad(set_to_none=True)
        ((losses[0] + batch.opacity_weight * losses[1]) / n).backward()
        start = int(field.layout[0, 12])
        grads[0, start : start + basis.numel()] += basis.grad.flatten().numpy()
        return np.array([losses[0].item(), losses[1].item(), len(ts) + SHADING_COST * len(seen)])

    def step(self, decay: float) -> None:
        """One step of Adam on the network."""
        for group in self.optimiser.param_groups:
            group["lr"] = NETWORK_RATE * decay
        self.optimiser.step()

    def numbers(self) -> list[torch.Tensor]:
        """The network's weights, and Adam's moments and steps of them."""
        held = self.optimiser.state
        return [v.detach() for weight, own in held.items() for v in (weight, *own.values())]

    def state(self) -> dict[str, np.ndarray]:
        """Adam's moments and step of each of the network's weights, by `<weight>.<name>`."""
        held = self.optimiser.state_dict()["state"]
        return {f"{i}.{name}": value.numpy() for i, own in held.items() for name, value in own.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Inverse of `state`."""
        held = {}
        for key, value in arrays.items():
            i, name = key.split(".")
            held.setdefault(int(i), {})[name] = torch.from_numpy(value.copy())
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": held})


PASSES: dict[str, type[Pass]] = {VMField.kind: FusedPass, VMMLPField.kind: PackedPass}


def visible_samples(field: VMMLPField, batch: Batch) -> tuple[np.ndarray, np.ndarray]:
    """Rays (S,) int64 and distances (S,) of the samples up to where a ray is opaque, in order."""
    trans = np.ones(len(batch.rays_o), np.float32)
    rays, distances = [np.zeros(0, np.int64)], [np.zeros(0)]
    rest = batch.near, batch.jitter, batch.step
    for ray, ts, counts in waves(field, batch.rays_o, batch.rays_d, *rest, lambda: trans > batch.early_stop):
        row, slot = np.nonzero(np.arange(ts.shape[1]) < counts[:, None])
        dirs = batch.rays_d[ray[row]]
        points = batch.rays_o[ray[row]] + ts[row, slot, None] * dirs
        sigma = np.zeros(ts.shape, np.float32)
        found = field.query(torch.from_numpy(points), torch.from_numpy(dirs), with_colour=False)[0]
        sigma[row, slot] = found.numpy()
        weights, after = weights_from_sigma(sigma, batch.step, trans[ray])
        before = trans[ray, None] - (np.cumsum(weights, 1) - weights)
        kept = before[row, slot] > batch.early_stop
        trans[ray] = after
        rays.append(ray[row[kept]])
        distances.append(ts[row[kept], slot[kept]])
    ray, ts = np.concatenate(rays), np.concatenate(distances)
    order = np.argsort(ray, kind="stable")
    return ray[order], ts[order]


def shaded_samples(
    weights: torch.Tensor, ray: torch.Tensor, jitter: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Indices (M,) of samples whose colour is asked, and their chances of it, min(1, weight / THIN_BELOW).

    Samples of weights under THIN_BELOW stand for their neighbours: along a ray one is taken each time the
    running sum passes another multiple of it. In the untrained haze that is one in twenty.
    """
    if not THIN_BELOW:
        seen = torch.nonzero(weights > bodies.COLOUR_FROM)[:, 0]
        return seen, torch.ones_like(weights[seen])
    total = weights.double().cumsum(0) / THIN_BELOW + (jitter * SCATTER % 1)[ray]
    crossed = total.floor() > (total - weights.double() / THIN_BELOW).floor()
    seen = torch.nonzero(crossed & (weights > bodies.COLOUR_FROM))[:, 0]
    return seen, (weights[seen] / THIN_BELOW).clamp(max=1)


def composite(depth: torch.Tensor, ray: torch.Tensor, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights (S,) of packed samples of optical depths (S,), and opacities (n,); rays (S,) ascend.

    The depth before a sample is the running sum over all less its value at the ray's first, hence float64.
    """
    exact = depth.double()
    before = exact.cumsum(0) - exact
    counts = torch.bincount(ray, minlength=n)
    first = (counts.cumsum(0) - counts)[ray]
    trans = torch.exp(before[first] - before)
    weights = trans * -torch.expm1(-exact)
    opacity = exact.new_zeros(n).index_add(0, ray, weights)
    return weights.to(depth.dtype), opacity.to(depth.dtype)
