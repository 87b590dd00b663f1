import torch
from dataclasses import replace
from test_observability import _told,_height
from bundle_oracles import *
def test_x(plant):
    planted=plant(cameras=5,points=40)
    t=planted.truth
    for scale,sh in [(1,0),(1,100.),(1,1000.),(1,8000.),(10,0),(.1,0),(10,100.)]:
        shift=torch.tensor((sh,-.5*sh,0.),dtype=torch.float64)
        p=replace(planted,truth=replace(t,center=scale*t.center+shift,points=scale*t.points+shift))
        for terms in ([],[_height(p.truth,.4*scale)]):
            print(scale,sh,len(terms),p.problem(terms=terms).gauge, {k:round(v.posterior,6) for k,v in _told(p,terms=terms).items()})
