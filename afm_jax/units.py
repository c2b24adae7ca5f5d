"""The unit system, and the unit suffixes that names carry: the only place with powers of ten.

Inside the program everything is in nm, us, ng and what follows from them coherently, so that no formula needs a
conversion factor:

========================  ==========  ==========================  ===================
quantity                  unit        quantity                    unit
========================  ==========  ==========================  ===================
length                    nm          force                       nN
time                      us          stiffness, surface tension  nN/nm = N/m
mass                      ng          energy                      aJ
speed                     nm/us       epsilon = 2 delta/m         nm^2/us^2 = uJ/kg
angular frequency         rad/us      elastic modulus             nN/nm^2 = GPa
========================  ==========  ==========================  ===================
"""

import math

RAD_PER_US_PER_KHZ = 2.0 * math.pi * 1e-3
"""Angular frequency in rad/us of a frequency of 1 kHz."""
