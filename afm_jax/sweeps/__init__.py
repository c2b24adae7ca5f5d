"""Sweeps over many scenes or many fits: in chunks, on all cores and devices or a cluster, resumed after faults."""
