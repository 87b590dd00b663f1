import torch
from dataclasses import replace
from torchrefrac.bundle import adjust_differentiably, adjust
from test_implicit import SQUARED
def test_x(plant):
    p=plant(cameras=4,points=15,noise=.5)
    for jac in ("exact","frozen_ratio"):
        o=replace(SQUARED,jacobian=jac)
        px=p.observations.pixels.clone().requires_grad_()
        s=adjust(p.truth,p.observations,o,terms=[p.gravity]); print(jac,s.status,s.iterations,s.costs[-1])
        r=adjust_differentiably(s.state,replace(p.observations,pixels=px),o,terms=[p.gravity])
        g,=torch.autograd.grad(r.center[:,2].sum(),px); print(g.norm(), g[:2])
