"""From a site, a link and poses to paths and channel matrices."""
