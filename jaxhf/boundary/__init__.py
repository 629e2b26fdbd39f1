"""The derivative of moving silhouettes and shadow boundaries."""
