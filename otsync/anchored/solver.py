"""Anchored fused Gromov-Wasserstein: from some 200 anchors to all tracks, coarse to fine."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ..costs import Cosine, Cost, fill_unseen, memberships, total_cost
from ..types import Matches, Status, TrackSet, in_order
from .anchors import AnchorProblem
from .cells import POSES, k_means
from .chirality import chirality
from .clouds import Cloud, clouds, comes_first
from .signatures import Linear, Scale, distances, shortlist, signatures

@dataclass(frozen=True)
class AnchoredFGW:
    cells: int = 2000
    anchors: int = 200
    mass: float = 0.8
    alpha: float = 0.222
    landmarks: int = 96
    tau: float = 0.05
    beta: float = 1.0
    rounds: int = 3
    restarts: int = 4
    costs: tuple[Cost, ...] = (Cosine(),)
    seed: int = 0
    K: int = 16
    dbg: object = None

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        t0=time.perf_counter()
        tm={}
        def tick(k):
            nonlocal t0
            tm[k]=tm.get(k,0)+time.perf_counter()-t0;t0=time.perf_counter()
        A,B=clouds(a,b); tick('clouds')
        rng=np.random.default_rng(self.seed)
        if max(len(A),len(B))>1.5*self.cells:
            la=k_means(A,self.cells,rng,2);lb=k_means(B,self.cells,rng,2); tick('kmeans')
            ca,cb=A.groups(la,la.max()+1),B.groups(lb,lb.max()+1); tick('groups')
            lin=Linear.of(self.costs,ca,cb)
        else:
            ca,cb=A,B
            lin=Linear.of(self.costs,ca,cb)
        basis=lin.basis(); tick('linear')
        full=None
        lin=lin.reduced(basis); tick('linear')
        sols=[]
        for r in range(self.restarts):
            sols.append(self.solve(ca,cb,lin,np.random.default_rng([self.seed,r]),tick)); 
        best=min(sols,key=lambda s:(s[4]<.9,s[3] if s[4]>=.9 else -s[4]))
        i,j,cost,res,chi,cands,marks,scale=best
        if ca is not A:
            L=Linear.of(self.costs,A,B).reduced(basis); tick('dlin')
            sg=signatures(A,B,marks,scale); tick('dsig')
            c=shortlist(sg,L,scale,self.K,(la,lb),cands.index); tick('dshort')
            i,j,cost=c.one_to_one(len(B)); tick('dgreedy')
        self.dbg is not None and print({k:round(v,3) for k,v in tm.items()},[(round(s[3],3),round(s[4],3)) for s in sols])
        return Matches(np.stack([A.index[i],B.index[j]],1),-cost,stats={'chirality':chi,'residual':res})

    def solve(self,ca,cb,lin,rng,tick):
        la,lb=k_means(ca,self.anchors,rng),k_means(cb,self.anchors,rng); tick('r.kmeans')
        ga,gb=ca.groups(la,la.max()+1),cb.groups(lb,lb.max()+1); tick('r.groups')
        Ca,Cb=(fill_unseen(distances(g,g)).astype(float) for g in (ga,gb))
        z=.5*(np.median(Ca)+np.median(Cb)); Ca/=z;Cb/=z
        M=total_cost(self.costs,ga.source,gb.source)
        pr=AnchorProblem(M,Ca,Cb,self.alpha); tick('r.prob')
        plans=[pr.solve(self.mass,s) for s in (None,pr.features_only(self.mass))]
        plan=min(plans,key=pr.objective); tick('r.fgw')
        from scipy.optimize import linear_sum_assignment as lsa
        i,j=lsa(plan,maximize=True); k=plan[i,j]>1e-9; i,j=i[k],j[k]
        gr=pr.gradient(plan)[i,j]; o=np.argsort(gr,kind='stable')[:max(8,int(.9*len(i)))]; i,j=i[o],j[o]
        marks=(ga.take(i),gb.take(j)); scale=Scale(z,self.tau,self.beta); tick('r.assign')
        glin=Linear.of(self.costs,ga,gb)
        for _ in range(self.rounds+1):
            from .kernels import spread_out
            if len(marks[0])>self.landmarks:
                s=spread_out(marks[0].poses(POSES),self.landmarks,0); marks=(marks[0].take(s),marks[1].take(s))
            tick('r.marks')
            allowed=shortlist(signatures(ga,gb,marks,scale),glin,scale,16).index; tick('r.gshort')
            sg=signatures(ca,cb,marks,scale); tick('r.sig')
            c=shortlist(sg,lin,scale,self.K,(la,lb),allowed); tick('r.short')
            i,j,cost=c.one_to_one(len(cb)); tick('r.greedy')
            n=max(self.landmarks,int(.4*len(i)))
            marks_=marks
            marks=(ca.take(i[:n]),cb.take(j[:n])); 
        h=len(i)//2
        chi=chirality(ca.take(i[:h]),cb.take(j[:h]),rng)[0]; tick('r.chir')
        s=spread_out(marks[0].poses(POSES),min(len(marks[0]),self.landmarks),0); marks=(marks[0].take(s),marks[1].take(s))
        return i,j,cost,float(cost[:h].mean()),chi,c,marks,scale
