"""C2C (Girardeau-Montaut et al. 2005, the paper's [7]): distances between two clouds, no network, no training."""
