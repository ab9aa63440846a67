"""A yielding frame under a measured earthquake, and spectra of many."""

from .accelerogram import Accelerogram as Accelerogram
from .frame import Frame as Frame
from .spectrum import Spectrum as Spectrum
from .spectrum import response_spectrum as response_spectrum
