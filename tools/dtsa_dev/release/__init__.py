"""The distribution `dtsa`: made for both kinds of processors, installed in fresh environments and tried there."""
