"""How pages look: one style sheet for all of them, light and dark, on a phone and on paper.

Good and doubtful differ in blue and orange, which all eyes tell apart, and in a sign and a word besides.
"""

STYLE = """
:root{color-scheme:light dark;--ink:#171a20;--soft:#59616f;--line:#dde2e9;--ground:#fff;--card:#f5f7fa;--good:#0b659e;
--doubt:#a84300;--bar:#a9c9e0;--shade:#0b659e14}
@media(prefers-color-scheme:dark){:root{--ink:#e8ebf0;--soft:#a2abb9;--line:#2b323d;--ground:#0e1116;--card:#171c24;
--good:#6cb8ea;--doubt:#f2a35c;--bar:#2f5f82;--shade:#6cb8ea1c}}
*{box-sizing:border-box}
body{font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif;margin:0 auto;max-width:66rem;
padding:2.2rem 1.25rem 3rem;color:var(--ink);background:var(--ground);overflow-wrap:break-word;
font-variant-numeric:tabular-nums}
h1{font-size:clamp(1.5rem,1.15rem + 1.6vw,2.1rem);line-height:1.2;letter-spacing:-.012em;margin:.15rem 0 .6rem;
text-wrap:balance}
h2{font-size:1.22rem;letter-spacing:-.006em;margin:2.8rem 0 .7rem;padding-top:1.1rem;border-top:1px solid var(--line)}
h3{font-size:1rem;margin:1.4rem 0 .4rem}
p{margin:.5rem 0;max-width:46rem}.lead{font-size:1.08rem}.kind,p.s,figcaption,.s{color:var(--soft);font-size:.875rem}
.kind{margin:0;letter-spacing:.02em}a{color:var(--good)}
.go{display:inline-block;margin:.5rem .6rem .5rem 0;padding:.5rem 1.05rem;border-radius:.5rem;background:var(--good);
color:var(--ground);font-weight:600;text-decoration:none}.go.second{background:none;color:var(--good);
box-shadow:inset 0 0 0 1.5px var(--good)}
.note{color:var(--soft);font-size:.9rem}.note i{color:var(--doubt);font-style:normal}
.ok{color:var(--good);font-weight:600}.no{color:var(--doubt);font-weight:600}
table{border-collapse:collapse;font-size:.9rem;margin:.4rem 0;width:100%}
td,th{padding:.42rem .7rem;text-align:right;border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--soft);font-weight:500;font-size:.82rem;vertical-align:bottom}
td:first-child,th:first-child,td.t,th.t{text-align:left}
td:first-child,th:first-child{padding-left:0;overflow-wrap:anywhere}
table.numbers{width:auto;display:inline-table;margin-right:2.5rem;vertical-align:top}
svg,img{max-width:100%;height:auto}.figs>*{min-width:0}
figure{margin:.6rem 0}figure img{display:block;width:100%;border-radius:.45rem}
figcaption{margin-top:.35rem}svg{display:block}
.figs{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,19rem),1fr));gap:.4rem 1.6rem;
align-items:start}
.stills{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,20rem),1fr));gap:1rem;margin:1.2rem 0}
.stills>figure{margin:0}.stills b{color:var(--ink)}
.mosaic{display:grid;gap:3px;border-radius:.45rem;overflow:hidden}.mosaic div{position:relative;background:var(--card)}
.mosaic img{display:block;width:100%;border-radius:0}.mosaic span{position:absolute;left:0;top:0;max-width:100%;
padding:.05rem .4rem;font-size:.72rem;background:#0e1116cc;color:#fff;border-radius:0 0 .3rem 0;overflow:hidden;
text-overflow:ellipsis;white-space:nowrap}

.clock{margin:1.2rem 0 .3rem}.row{display:grid;grid-template-columns:13.5rem minmax(0,1fr);gap:.9rem;align-items:center;
margin:.42rem 0}.who{font-size:.875rem;line-height:1.35;min-width:0}.who b{display:block;overflow-wrap:anywhere}
.who .s{display:block}.lane{position:relative;min-height:1.4rem;border-radius:.3rem;background:var(--card)}
.bar{position:relative;min-height:1.4rem;border-radius:.3rem;overflow:hidden;background:var(--bar);
box-shadow:inset 0 0 0 2px var(--good)}
.bar img{display:block;width:100%;height:auto;border-radius:0}
.bar::after{content:"";position:absolute;inset:0;border-radius:.3rem;box-shadow:inset 0 0 0 2px var(--good)}
.bar.unsure{background:repeating-linear-gradient(135deg,var(--card) 0 5px,var(--line) 5px 10px);
box-shadow:inset 0 0 0 2px var(--doubt)}.bar.unsure::after{box-shadow:inset 0 0 0 2px var(--doubt)}
.mark{position:absolute;top:-.3rem;bottom:-.3rem;border-left:2px dashed var(--soft);pointer-events:none}
.none{font-size:.82rem;color:var(--doubt);padding:.1rem .5rem}
.axis{position:relative;height:1.3rem;font-size:.78rem;color:var(--soft)}
.axis span{position:absolute;transform:translateX(-50%);white-space:nowrap}
.axis span::before{content:"";position:absolute;left:50%;top:-.3rem;height:.25rem;border-left:1px solid var(--soft)}
.steps{list-style:none;padding:0;margin:.5rem 0;font-size:.9rem;max-width:34rem}
.steps li{display:grid;grid-template-columns:12rem 1fr 4.2rem;gap:.7rem;align-items:center;margin:.2rem 0}
.steps i{height:.55rem;border-radius:.2rem;background:var(--good);opacity:.75;min-width:2px}
.steps span:last-child{text-align:right;color:var(--soft)}
details{border:1px solid var(--line);border-radius:.55rem;margin:.55rem 0;background:var(--card)}
summary{cursor:pointer;padding:.6rem .9rem;display:block}summary>*{margin-right:.8rem}
summary::before{content:"▸";color:var(--soft);margin-right:.6rem}details[open]>summary::before{content:"▾"}
summary b,figcaption,h1,.lead,.none{overflow-wrap:anywhere}
summary::-webkit-details-marker{display:none}
summary:focus-visible{outline:2px solid var(--good);outline-offset:2px;border-radius:.5rem}
.inside{padding:.1rem .9rem .9rem}
dl{margin:.8rem 0;max-width:46rem}dt{font-weight:600;margin-top:.6rem}dd{margin:0 0 .3rem}
ul{padding-left:1.2rem;max-width:46rem}
footer{margin-top:3rem;padding-top:.9rem;border-top:1px solid var(--line);color:var(--soft);font-size:.82rem}
.scroll{overflow-x:auto}
@media(max-width:44rem){body{padding:1.3rem 1rem 2rem}h2{margin-top:2.1rem}
.row{grid-template-columns:minmax(0,1fr);gap:.25rem;margin:.85rem 0}.who b{display:inline}
.who .s{display:inline;margin-left:.5rem}
table.cards,table.cards tbody{display:block}table.cards tr:first-child{display:none}
table.cards tr{display:grid;grid-template-columns:repeat(2,minmax(0,1fr));gap:.1rem 1rem;padding:.7rem 0;
border-bottom:1px solid var(--line)}
table.cards td{display:block;border:0;padding:0;text-align:left}
table.cards td:first-child{grid-column:1/-1;font-weight:600;font-size:.98rem}
table.cards td[data-l]::before{content:attr(data-l);display:block;color:var(--soft);font-size:.78rem;
font-weight:400;line-height:1.3}
.steps li{grid-template-columns:8rem 1fr 3.6rem}}
@media print{:root{--ink:#000;--soft:#444;--line:#bbb;--ground:#fff;--card:#fff;--good:#0b659e;--doubt:#a84300;
--bar:#a9c9e0}body{max-width:none;padding:0;font-size:10.5pt}h2{break-after:avoid;margin-top:1.4rem}
tr,.row,figure,details,dt{break-inside:avoid}.stills{grid-template-columns:1fr 1fr}.go{display:none}
a{color:inherit;text-decoration:none}.bar,.stills img{print-color-adjust:exact;-webkit-print-color-adjust:exact}}
"""
