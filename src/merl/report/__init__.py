"""Reports: learning curves of runs, their uncertainty, and figures of them.

They are made from run folders alone and need neither torch nor MuJoCo.
"""

from merl.core.resources import load_matplotlib

load_matplotlib()
