"""Latent consistency distillation (Luo et al. 2023): a network that has learnt to denoise learns to jump.

The student answers the same from a noisier point and from the point that its teacher reaches from there in one DDIM
step. The nearer answer is the student's own, without a gradient (Song and Dhariwal 2024: no moving average of it).
"""

from __future__ import annotations

import copy

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.network.conditioning import COLOUR, DEPTH, Condition, without_photo
from mv3d_cli.diffusion.noise import clean_from_prediction, noise_from_prediction, noisy_from_clean
from mv3d_cli.diffusion.sampling import consistency
from mv3d_cli.diffusion.training.objectives import Batch, condition_of, generators, signal_and_noise

DDIM_STEPS = 50  # of the teacher, from noise to clean
HUBER = 0.001  # of the pseudo-Huber distance, as in the authors' code


class DistillationObjective(nn.Module):
    """The distance between the student's answers on two neighbouring points of its teacher's path.

    guidance  of the teacher; the student needs none then
    """

    def __init__(self, model: Model, guidance: float = 1.0, dtype: torch.dtype = torch.bfloat16):
        super().__init__()
        self.network = model.network
        # hidden in a tuple: neither trained, nor saved, nor wrapped
        self._frozen = (copy.deepcopy(model.network).requires_grad_(False), model.encoder.requires_grad_(False))
        self.schedule, self.guidance, self.dtype = model.schedule, guidance, dtype

    def forward(self, batch: Batch) -> Float[Tensor, ""]:
        """The mean loss over the objects."""
        clean, device = batch.latents, batch.latents.device
        draws = [*generators(batch.seeds)]
        stride = len(self.schedule.alpha) // DDIM_STEPS
        place = torch.tensor([int(torch.randint(1, DDIM_STEPS + 1, (), generator=generator)) for generator in draws])
        far, near = place * stride - 1, (place - 1) * stride - 1
        noise = torch.stack([torch.randn(clean.shape[1:], generator=generator) for generator in draws]).to(device)
        noisy = noisy_from_clean(self.schedule, clean, noise, far)
        with torch.autocast(device.type, self.dtype, enabled=self.dtype != torch.float32):
            tasks = torch.tensor([[COLOUR, DEPTH]], device=device).expand(len(clean), -1)
            condition = condition_of(batch, self._frozen[1](batch.photo), tasks)
            nearer = self._teachers_step(noisy, far, near, condition)
            wanted = self._nearer_answer(nearer, near, condition)
            prediction = self.network(noisy, far.to(device), condition).float()
        answer = consistency(self.schedule, prediction, noisy, far)
        return ((answer - wanted).square() + HUBER**2).sqrt().mean() - HUBER

    def parameters_in_training(self) -> list[nn.Parameter]:
        """The network's; the photo encoder stays as the teacher knows it."""
        return [*self.network.parameters()]

    @torch.no_grad()
    def _teachers_step(
        self, noisy: Tensor, far: Int[Tensor, " objects"], near: Int[Tensor, " objects"], condition: Condition
    ) -> Tensor:
        """The latents at `near` to which the (guided) teacher's DDIM step leads; -1 is clean."""
        teacher = self._frozen[0]
        prediction = teacher(noisy, far.to(noisy.device), condition).float()
        if self.guidance != 1:
            without = teacher(noisy, far.to(noisy.device), without_photo(condition)).float()
            prediction = without + self.guidance * (prediction - without)
        clean = clean_from_prediction(self.schedule, prediction, noisy, far)
        noise = noise_from_prediction(self.schedule, prediction, noisy, far)
        alpha, sigma = signal_and_noise(self.schedule, near, noisy)
        return alpha * clean + sigma * noise

    @torch.no_grad()
    def _nearer_answer(self, nearer: Tensor, near: Int[Tensor, " objects"], condition: Condition) -> Tensor:
        """What the student says from there; what is clean already is its own answer, as it is at timestep 0."""
        when = near.clamp_min(0)
        prediction = self.network(nearer, when.to(nearer.device), condition).float()
        return consistency(self.schedule, prediction, nearer, when)
