"""How the page looks: light and dark, on a screen and on paper. Without it the page reads as well."""

STYLE = """
:root { color-scheme: light dark; --ink: #1b1b1b; --paper: #ffffff; --faint: #5d5d5d; --line: #cfcfcf; --shade: #f3f3f3;
  --good: #11663b; --bad: #b00020; --mark: #fff3d6; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --paper: #161616; --faint: #a8a8a8; --line: #454545;
  --shade: #232323; --good: #6fd39b; --bad: #ff8a94; --mark: #43371a; } }
body { margin: 0 auto; max-width: 64rem; padding: 1rem; background: var(--paper); color: var(--ink);
  font: 1rem/1.5 system-ui, sans-serif; }
h1 { font-size: 1.4rem; margin: 0 0 .6rem; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
.verdict { border-left: .5rem solid; padding: .2rem .9rem; background: var(--shade); }
.verdict > p:first-child { font-size: 1.25rem; font-weight: 700; margin: .3rem 0; }
.good { border-color: var(--good); } .good > p:first-child { color: var(--good); }
.bad { border-color: var(--bad); } .bad > p:first-child { color: var(--bad); }
.formula { font: italic 1.3rem/1.6 Cambria, Georgia, serif; margin: .4rem 0; }
sub, sup { font-size: .7em; line-height: 0; }
.wide { overflow-x: auto; margin: .6rem 0; width: max-content; }
.wide { max-width: max(100%, min(100vw - 3rem, 50vw + 30rem)); }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .88rem; }
caption { text-align: left; color: var(--faint); padding-bottom: .25rem; }
th, td { padding: .15rem .55rem; border-bottom: 1px solid var(--line); text-align: right; vertical-align: top; }
th { font-weight: 600; } th:first-child, .words { text-align: left; } td.words { min-width: 6rem; }
thead th { vertical-align: bottom; }
.marked > * { background: var(--mark); } .marked > td.words { white-space: nowrap; }
figure { margin: .8rem 0; } img { max-width: 100%; height: auto; background: #ffffff; }
figcaption { color: var(--faint); }
nav a { margin-right: .9rem; white-space: nowrap; } a { color: inherit; }
footer { margin-top: 2rem; color: var(--faint); }
@page { size: landscape; margin: 12mm; }
@media print { body { max-width: none; padding: 0; font-size: 10pt; } nav { display: none; }
  .wide { overflow: visible; width: auto; max-width: none; } .marked > td.words { white-space: normal; }
  table { font-size: 7pt; } th, td { padding: .1rem .3rem; } thead { display: table-header-group; }
  figure, tr, .verdict { break-inside: avoid; } h2 { break-after: avoid; } }
"""
