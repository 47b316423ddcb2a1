//! Large least squares: bundle adjustment, rotation and translation averaging, Sim(3) graphs.
